//! Who may ask: this machine, from this page.
//!
//! A server on 127.0.0.1 is out of reach of other machines, but not of other pages in the same
//! browser. A page whose name was made to point to 127.0.0.1 (DNS rebinding) shows in `Host`, a
//! request that another page sends shows in `Origin` and `Sec-Fetch-Site`.

use axum::extract::Request;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

/// Nothing from elsewhere. Pictures are made in the page (`blob:`), the chart library sets styles by
/// script, which needs no permission.
pub const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; \
    img-src 'self' blob: data:; connect-src 'self'; media-src 'self' blob:; base-uri 'none'; \
    form-action 'none'; frame-ancestors 'none'";

/// Refuses what does not come from this machine, and puts the policy on what goes out.
pub async fn guard(request: Request, next: Next) -> Response {
    let mut response = if is_ours(request.headers()) {
        next.run(request).await
    } else {
        let words = "This viewer answers only to localhost, 127.0.0.1 and [::1]. Through ssh -L, \
                     open http://localhost:PORT/.\n";
        (StatusCode::FORBIDDEN, words).into_response()
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
    let origin = match text(header::ORIGIN) {
        None => true,
        Some(origin) => origin
            .and_then(|o| o.strip_prefix("http://"))
            .is_some_and(|o| Some(o) == host),
    };
    let site = headers.get("sec-fetch-site").map(HeaderValue::as_bytes);
    let site = !matches!(site, Some(b"cross-site"));
    host.is_some_and(is_this_machine) && origin && site
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
    }
}
