//! Who may ask: this machine, from this page, with the token of this server.
//!
//! A server on 127.0.0.1 is out of reach of other machines, but not of other pages in the same
//! browser. A page whose name was made to point to 127.0.0.1 (DNS rebinding) shows in `Host`, a
//! request that another page sends shows in `Origin` and `Sec-Fetch-Site`. Other users of the machine can reach the
//! port as well: the address that is printed has a token, which the page then keeps in a cookie.

use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use std::sync::Arc;

/// Nothing from elsewhere. Pictures are made in the page (`blob:`), the chart library sets styles by
/// script, which needs no permission.
pub const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; \
    img-src 'self' blob: data:; connect-src 'self'; media-src 'self' blob:; base-uri 'none'; \
    form-action 'none'; frame-ancestors 'none'";

/// The secret of one server.
#[derive(Clone)]
pub struct Token {
    text: Arc<str>,
    cookie_name: Arc<str>,
}

impl Token {
    /// A token of 128 random bits for the server on `port`. Browsers share cookies among ports, so each has its name.
    ///
    /// # Errors
    /// The system gives no random numbers.
    pub fn new(port: u16) -> Result<Self, getrandom::Error> {
        let mut bytes = [0u8; 16];
        getrandom::fill(&mut bytes)?;
        let text: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(Self {
            text: text.into(),
            cookie_name: format!("rowburst-{port}").into(),
        })
    }

    /// The token in an address.
    pub fn query(&self) -> String {
        format!("token={}", self.text)
    }

    fn cookie(&self) -> String {
        format!(
            "{}={}; Path=/; HttpOnly; SameSite=Strict",
            self.cookie_name, self.text
        )
    }

    fn is_in_query(&self, request: &Request) -> bool {
        let query = request.uri().query().unwrap_or_default();
        let mut tokens = query.split('&').filter_map(|p| p.strip_prefix("token="));
        tokens.any(|text| self.is(text))
    }

    fn is_in_cookie(&self, headers: &HeaderMap) -> bool {
        let cookies = headers.get_all(header::COOKIE).iter();
        let pairs = cookies
            .filter_map(|value| value.to_str().ok())
            .flat_map(|v| v.split(';'))
            .filter_map(|pair| pair.trim().split_once('='));
        pairs
            .filter(|(name, _)| *name == &*self.cookie_name)
            .any(|(_, text)| self.is(text))
    }

    /// Compares in a time that does not depend on where the texts differ.
    fn is(&self, text: &str) -> bool {
        let pairs = self.text.bytes().zip(text.bytes());
        text.len() == self.text.len() && pairs.fold(0, |acc, (a, b)| acc | (a ^ b)) == 0
    }
}

/// Refuses what does not come from this machine and what lacks the token, and puts the policy on what goes out.
pub async fn guard(State(token): State<Token>, request: Request, next: Next) -> Response {
    let is_from_here =
        is_ours(request.headers()) && request.uri().host().is_none_or(is_this_machine);
    let refuse = |words: &'static str| (StatusCode::FORBIDDEN, words).into_response();
    let mut response = if !is_from_here {
        refuse(
            "This viewer answers only to localhost, 127.0.0.1 and [::1]. Through ssh -L, \
             open the address that rowburst has printed.\n",
        )
    } else if has_body(request.headers()) {
        (
            StatusCode::PAYLOAD_TOO_LARGE,
            "No request has a body here.\n",
        )
            .into_response()
    } else if token.is_in_query(&request) && request.uri().path() == "/" {
        // The page goes on with the cookie, so that the token does not stay in the address.
        let headers = [
            (header::LOCATION, "/".to_string()),
            (header::SET_COOKIE, token.cookie()),
        ];
        (StatusCode::SEE_OTHER, headers).into_response()
    } else if token.is_in_query(&request) || token.is_in_cookie(request.headers()) {
        next.run(request).await
    } else {
        refuse("Open the address that rowburst has printed: it holds the token of this viewer.\n")
    };
    let headers = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-store"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers.insert(
        "cross-origin-resource-policy",
        HeaderValue::from_static("same-origin"),
    );
    response
}

fn is_ours(headers: &HeaderMap) -> bool {
    let text = |name| headers.get(name).map(|v: &HeaderValue| v.to_str().ok());
    let host = text(header::HOST).flatten();
    let has_one_host = headers.get_all(header::HOST).iter().count() == 1;
    let origin = match text(header::ORIGIN) {
        None => true,
        Some(origin) => origin
            .and_then(|o| o.strip_prefix("http://"))
            .is_some_and(|o| Some(o) == host),
    };
    let site = headers.get("sec-fetch-site").map(HeaderValue::as_bytes);
    let site = !matches!(site, Some(b"cross-site"));
    has_one_host && host.is_some_and(is_this_machine) && origin && site
}

/// Whether a body follows. None of the requests of the page has one.
fn has_body(headers: &HeaderMap) -> bool {
    let length = headers.get(header::CONTENT_LENGTH);
    headers.contains_key(header::TRANSFER_ENCODING) || length.is_some_and(|v| v.as_bytes() != b"0")
}

/// Whether `host` (with or without a port) is a name of this machine.
fn is_this_machine(host: &str) -> bool {
    let (name, port) = match host.rsplit_once(':') {
        // The colons of an address without a port stand within its brackets.
        Some((name, port)) if !port.ends_with(']') => (name, Some(port)),
        _ => (host, None),
    };
    let name = name.to_ascii_lowercase();
    ["localhost", "127.0.0.1", "[::1]"].contains(&name.as_str())
        && port.is_none_or(|p| !p.is_empty() && p.bytes().all(|b| b.is_ascii_digit()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(&'static str, &'static str)]) -> HeaderMap {
        let pair = |&(n, v): &(&'static str, &'static str)| {
            (n.parse().unwrap(), HeaderValue::from_static(v))
        };
        pairs.iter().map(pair).collect()
    }

    #[test]
    fn only_names_of_this_machine() {
        for good in [
            "localhost",
            "LocalHost:1",
            "127.0.0.1:8787",
            "[::1]",
            "[::1]:80",
        ] {
            assert!(is_this_machine(good), "{good}");
        }
        for bad in [
            "",
            "example.org",
            "localhost.example.org",
            "127.0.0.1.example.org:80",
            "localhost:80:80",
            "localhost:",
            "evil@localhost:x",
            "127.0.0.2",
            "0.0.0.0:8787",
        ] {
            assert!(!is_this_machine(bad), "{bad}");
        }
    }

    #[test]
    fn only_pages_of_this_server() {
        let host = ("host", "localhost:9");
        assert!(is_ours(&headers(&[host])));
        assert!(is_ours(&headers(&[host, ("origin", "http://localhost:9")])));
        assert!(is_ours(&headers(&[host, ("sec-fetch-site", "none")])));
        for bad in [
            ("origin", "http://evil.example"),
            ("origin", "null"),
            ("origin", "http://localhost:10"),
            ("sec-fetch-site", "cross-site"),
        ] {
            assert!(!is_ours(&headers(&[host, bad])), "{bad:?}");
        }
        assert!(!is_ours(&HeaderMap::new()));
        let mut two = headers(&[host]);
        two.append("host", HeaderValue::from_static("evil.example"));
        assert!(!is_ours(&two));
    }

    #[test]
    fn a_token_is_compared_whole() {
        let token = Token::new(8787).unwrap();
        let text = token.query()["token=".len()..].to_string();
        assert_eq!(text.len(), 32);
        assert!(token.is(&text));
        assert!(!token.is(&text[1..]) && !token.is(&format!("{text}0")) && !token.is(""));
        assert_ne!(Token::new(8787).unwrap().query(), token.query());
        let cookie = HeaderValue::from_str(&format!("a=b; rowburst-8787={text}")).unwrap();
        let headers = HeaderMap::from_iter([(header::COOKIE, cookie)]);
        assert!(token.is_in_cookie(&headers));
        let other = HeaderValue::from_str(&format!("rowburst-8788={text}")).unwrap();
        assert!(!token.is_in_cookie(&HeaderMap::from_iter([(header::COOKIE, other)])));
    }
}
