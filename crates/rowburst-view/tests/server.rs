//! The server as a browser, another page and another program meet it.

use rowburst::{Image, Shape, Video};
use rowburst_io::{OutputFolder, write_npy_image, write_npy_u8, write_npy_video};
use rowburst_view::{Live, LiveStart, ProgressPoint, ResultFiles, RunStatus, Server, VideoAxes};
use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// A result folder of three bins of 4×5 pixels, with a file beside it that is nobody's business.
fn folder() -> tempfile::TempDir {
    let base = tempfile::tempdir().unwrap();
    let out = OutputFolder::create(&base.path().join("result")).unwrap();
    let video = Video::new(Shape::new(3, 4, 5), (0..60).map(|v| v as f32).collect()).unwrap();
    out.write("video.npy", |w| write_npy_video(w, &video))
        .unwrap();
    out.write_bytes("result.json", br#"{"frame_rate_hz": 100000.0}"#)
        .unwrap();
    out.write_bytes("private.txt", b"secret").unwrap();
    fs::write(base.path().join("outside.txt"), "secret").unwrap();
    base
}

fn served(base: &Path) -> Server {
    let opened = ResultFiles::open(&base.join("result")).unwrap();
    Server::start(Some(0), vec![opened], None).unwrap()
}

/// Address and token of the server.
fn address_and_token(server: &Server) -> (String, String) {
    let url = server.url();
    let (address, token) = url["http://".len()..].split_once("/?token=").unwrap();
    assert!(address.starts_with("127.0.0.1:"), "{address}");
    (address.to_string(), token.to_string())
}

fn connect(server: &Server) -> TcpStream {
    TcpStream::connect(address_and_token(server).0).unwrap()
}

/// The header with the cookie that the page has.
fn cookie(server: &Server) -> String {
    let (address, token) = address_and_token(server);
    let port = address.rsplit(':').next().unwrap();
    format!("Cookie: rowburst-{port}={token}\r\n")
}

/// Sends a request as it stands; returns status line with headers, and body.
fn ask(server: &Server, request: &str) -> (String, Vec<u8>) {
    let mut stream = connect(server);
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let end = answer.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
    let head = String::from_utf8(answer[..end].to_vec()).unwrap();
    (head.to_lowercase(), answer[end + 4..].to_vec())
}

fn get(server: &Server, path: &str) -> (String, Vec<u8>) {
    get_with(
        server,
        path,
        &format!("Host: localhost\r\n{}", cookie(server)),
    )
}

fn get_with(server: &Server, path: &str, headers: &str) -> (String, Vec<u8>) {
    let request = format!("GET {path} HTTP/1.1\r\n{headers}Connection: close\r\n\r\n");
    ask(server, &request)
}

#[test]
fn the_page_and_the_files_that_it_names_are_served() {
    let base = folder();
    let server = served(base.path());
    let (head, page) = get(&server, "/");
    assert!(head.contains("content-type: text/html"), "{head}");
    let page = String::from_utf8(page).unwrap();
    for (name, kind, begins) in [
        ("app.js", "text/javascript", "\"use strict\";"),
        ("app.css", "text/css", ".uplot"),
    ] {
        assert!(page.contains(&format!("\"{name}\"")), "{name} in {page}");
        let (head, body) = get(&server, &format!("/{name}"));
        assert!(head.starts_with("http/1.1 200"), "{head}");
        assert!(head.contains(&format!("content-type: {kind}")), "{head}");
        assert!(body.starts_with(begins.as_bytes()), "{name}");
    }
}

#[test]
fn bins_come_with_their_scale_and_a_policy() {
    let base = folder();
    let server = served(base.path());
    let (head, body) = get(&server, "/api/result/0/bins/video?from=1&to=3");
    assert!(head.starts_with("http/1.1 200"), "{head}");
    assert!(head.contains("x-range: 0 59"), "{head}");
    assert!(head.contains("default-src 'none'"), "{head}");
    assert!(!head.contains("access-control-allow-origin"), "{head}");
    let numbers = body.as_chunks::<2>().0;
    assert_eq!(numbers.len(), 40);
    let value = |i: usize| f64::from(u16::from_le_bytes(numbers[i])) * 59.0 / 65_534.0;
    assert!((value(0) - 20.0).abs() < 1e-3 && (value(39) - 59.0).abs() < 1e-3);

    let (_, meta) = get(&server, "/api/view");
    let meta: serde_json::Value = serde_json::from_slice(&meta).unwrap();
    assert_eq!(
        meta["results"][0]["shape"],
        serde_json::json!([3usize, 4, 5])
    );
    assert_eq!(meta["results"][0]["bin_duration_us"], 10.0);
    for bad in [
        "from=0&to=9",
        "from=2&to=1",
        "from=0",
        "from=-1&to=2",
        "from=x&to=2",
    ] {
        let (head, _) = get(&server, &format!("/api/result/0/bins/video?{bad}"));
        assert!(head.starts_with("http/1.1 400"), "{bad}: {head}");
    }
    for none in ["/api/result/1/bins/video", "/api/result/0/bins/truth"] {
        let (head, _) = get(&server, &format!("{none}?from=0&to=1"));
        assert!(head.starts_with("http/1.1 404"), "{none}: {head}");
    }
}

#[test]
fn masks_are_served_where_the_description_names_them() {
    let base = folder();
    let result = base.path().join("result");
    let out = OutputFolder::create(&result).unwrap();
    let frame = Image::new(2, 2, vec![1.0; 4]).unwrap();
    out.write("view-frame.npy", |w| write_npy_image(w, &frame))
        .unwrap();
    let mut coverage = [1u8; 60];
    coverage[20] = 0;
    out.write("coverage.npy", |w| write_npy_u8(w, &[3, 4, 5], &coverage))
        .unwrap();
    let write_excluded = |shape: &[usize], mask: &[u8]| {
        out.write("excluded.npy", |w| write_npy_u8(w, shape, mask))
            .unwrap();
    };
    let meta_of = |view: &[u8]| {
        out.write_bytes("view.json", view).unwrap();
        ResultFiles::open(&result).unwrap().meta().clone()
    };
    let named: &[u8] = br#"{"excluded": "excluded.npy", "coverage": "coverage.npy"}"#;

    // The description of an earlier version, or of a result without anything to mark.
    write_excluded(&[2, 2], &[0, 0, 1, 0]);
    let meta = meta_of(b"{}");
    assert!(meta["images"].get("excluded").is_none() && meta["ranges"].get("coverage").is_none());
    // A mask of another result's size.
    write_excluded(&[1, 4], &[0, 0, 1, 0]);
    assert!(meta_of(named)["images"].get("excluded").is_none());

    write_excluded(&[2, 2], &[0, 0, 1, 0]);
    let meta = meta_of(named);
    assert_eq!(meta["images"]["excluded"], meta["images"]["frame"]);
    assert_eq!(meta["ranges"]["coverage"], serde_json::json!([0.0, 1.0]));
    let server = served(base.path());
    let (head, body) = get(&server, "/api/result/0/image/excluded");
    assert!(head.contains("x-shape: 2 2"), "{head}");
    assert_eq!(body[8..12], 1.0f32.to_le_bytes());
    let (_, body) = get(&server, "/api/result/0/bins/coverage?from=1&to=2");
    assert_eq!(body[..4], [0, 0, 254, 255]);
}

#[test]
fn nothing_but_named_files_leaves_the_folder() {
    let base = folder();
    let server = served(base.path());
    let (head, body) = get(&server, "/api/result/0/file/result.json");
    assert!(head.starts_with("http/1.1 200"), "{head}");
    assert!(head.contains("attachment"), "{head}");
    assert_eq!(body, br#"{"frame_rate_hz": 100000.0}"#);
    for path in [
        "/api/result/0/file/private.txt",
        "/api/result/0/file/../outside.txt",
        "/api/result/0/file/..%2Foutside.txt",
        "/api/result/0/file/%2e%2e%2foutside.txt",
        "/api/result/0/file/..%5Coutside.txt",
        "/api/result/0/file//etc/passwd",
        "/api/result/0/file/%2Fetc%2Fpasswd",
        "/api/result/0/image/..%2Foutside.txt",
        "/api/result/0/image/view-frame.npy",
        "/../outside.txt",
        "/..%2F..%2FCargo.toml",
        "/private.txt",
        "/app.js/../private.txt",
    ] {
        let (head, body) = get(&server, path);
        assert!(
            head.starts_with("http/1.1 404") || head.starts_with("http/1.1 400"),
            "{path}: {head}"
        );
        let text = String::from_utf8_lossy(&body);
        assert!(
            !text.contains("secret") && !text.contains("root:"),
            "{path}"
        );
    }
}

#[test]
fn other_names_and_other_pages_are_refused() {
    let base = folder();
    let server = served(base.path());
    let with = |headers: &str| {
        let headers = format!("{headers}{}", cookie(&server));
        get_with(&server, "/api/view", &headers).0
    };
    for host in ["localhost:8787", "127.0.0.1", "[::1]:9"] {
        assert!(
            with(&format!("Host: {host}\r\n")).starts_with("http/1.1 200"),
            "{host}"
        );
    }
    for headers in [
        "Host: evil.example\r\n",
        "Host: localhost.evil.example:8787\r\n",
        "Host: localhost:8787\r\nOrigin: http://evil.example\r\n",
        "Host: localhost:8787\r\nSec-Fetch-Site: cross-site\r\n",
        "Host: localhost:8787\r\nHost: evil.example\r\n",
        "Host: localhost:8787\r\nHost: localhost:8787\r\n",
        "",
    ] {
        let head = with(headers);
        assert!(head.starts_with("http/1.1 40"), "{headers}: {head}");
    }
    // An absolute address with another host.
    let headers = format!("Host: localhost\r\n{}", cookie(&server));
    let (head, _) = get_with(&server, "http://evil.example/api/view", &headers);
    assert!(head.starts_with("http/1.1 40"), "{head}");
}

#[test]
fn nothing_is_served_without_the_token() {
    let base = folder();
    let server = served(base.path());
    let (address, token) = address_and_token(&server);
    let host = "Host: localhost\r\n";
    let port = address.rsplit(':').next().unwrap();
    let paths = [
        "/",
        "/app.js",
        "/api/view",
        "/api/result/0/file/result.json",
    ];
    for path in paths {
        for more in [
            String::new(),
            format!("Cookie: rowburst-{port}=\r\n"),
            format!("Cookie: rowburst-{port}={}\r\n", "0".repeat(32)),
            format!("Cookie: rowburst-1={token}\r\n"),
        ] {
            let (head, body) = get_with(&server, path, &format!("{host}{more}"));
            assert!(head.starts_with("http/1.1 403"), "{path}, {more}: {head}");
            assert!(!head.contains("set-cookie"), "{head}");
            let words = String::from_utf8(body).unwrap();
            assert!(
                words.contains("address that rowburst has printed"),
                "{words}"
            );
        }
    }
    let (head, _) = get_with(&server, "/?token=0", host);
    assert!(head.starts_with("http/1.1 403"), "{head}");
    // The printed address gives the cookie, and leads to the page without the token in its address.
    let (head, _) = get_with(&server, &format!("/?token={token}"), host);
    assert!(head.starts_with("http/1.1 303"), "{head}");
    assert!(head.contains("location: /\r\n"), "{head}");
    let set = format!("set-cookie: rowburst-{port}={token}; path=/; httponly; samesite=strict");
    assert!(head.contains(&set), "{head}");
    // Another program may give it with each request.
    let (head, _) = get_with(&server, &format!("/api/view?token={token}"), host);
    assert!(head.starts_with("http/1.1 200"), "{head}");
}

#[cfg(unix)]
#[test]
fn links_that_leave_the_folder_are_not_followed() {
    use std::os::unix::fs::symlink;
    let base = folder();
    let result = base.path().join("result");
    let outside = base.path().join("outside.txt");
    symlink(&outside, result.join("traces.csv")).unwrap();
    symlink("../outside.txt", result.join("report.html")).unwrap();
    symlink("video.npy", result.join("background.npy")).unwrap();
    let server = served(base.path());
    for name in ["traces.csv", "report.html"] {
        let (head, _) = get(&server, &format!("/api/result/0/file/{name}"));
        assert!(head.starts_with("http/1.1 404"), "{name}: {head}");
    }
    let (_, meta) = get(&server, "/api/view");
    let meta: serde_json::Value = serde_json::from_slice(&meta).unwrap();
    let files = meta["results"][0]["files"].to_string();
    assert!(
        !files.contains("traces.csv") && files.contains("background.npy"),
        "{files}"
    );
    // A link that was put there after the result was opened.
    fs::remove_file(result.join("background.npy")).unwrap();
    symlink(&outside, result.join("background.npy")).unwrap();
    let (head, _) = get(&server, "/api/result/0/file/background.npy");
    assert!(head.starts_with("http/1.1 404"), "{head}");
    // The video itself elsewhere.
    fs::rename(result.join("video.npy"), base.path().join("video.npy")).unwrap();
    symlink("../video.npy", result.join("video.npy")).unwrap();
    let error = ResultFiles::open(&result).err().unwrap().to_string();
    assert!(error.contains("link to a file elsewhere"), "{error}");
}

#[test]
fn slow_and_many_clients_do_not_block_others() {
    let base = folder();
    let server = served(base.path());
    // More than the server keeps at once, none of which ends its request.
    let mut slow: Vec<TcpStream> = (0..80).map(|_| connect(&server)).collect();
    for stream in &mut slow {
        stream.write_all(b"GET / HTTP/1.1\r\nHost: local").unwrap();
    }
    let begun = std::time::Instant::now();
    let (head, _) = get(&server, "/api/view");
    assert!(head.starts_with("http/1.1 200"), "{head}");
    let waited = begun.elapsed().as_secs();
    assert!(waited < 20, "{waited} s");
    // The server has ended them.
    let mut answer = Vec::new();
    slow[0].read_to_end(&mut answer).unwrap();
    assert!(
        answer.is_empty() || answer.starts_with(b"HTTP/1.1 4"),
        "{answer:?}"
    );
}

#[test]
fn bodies_are_refused() {
    let base = folder();
    let server = served(base.path());
    for body in [
        "Content-Length: 9999999\r\n",
        "Transfer-Encoding: chunked\r\n",
    ] {
        let headers = format!("Host: localhost\r\n{}{body}", cookie(&server));
        let (head, _) = get_with(&server, "/api/view", &headers);
        assert!(head.starts_with("http/1.1 413"), "{head}");
    }
}

#[test]
fn two_browsers_at_once() {
    let base = folder();
    let server = served(base.path());
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                for _ in 0..20 {
                    let (head, body) = get(&server, "/api/result/0/bins/video?from=0&to=3");
                    assert!(head.starts_with("http/1.1 200"), "{head}");
                    assert_eq!(body.len(), 120);
                }
            });
        }
    });
}

#[test]
fn a_folder_that_is_no_whole_result_says_why() {
    let base = folder();
    let error = |path: &Path| ResultFiles::open(path).err().unwrap().to_string();
    let result = base.path().join("result");
    assert!(error(base.path()).contains("no result.json"));
    assert!(error(&base.path().join("nothing")).contains("nothing"));
    fs::write(result.join("result.json"), "{").unwrap();
    assert!(error(&result).contains("result.json"));
    fs::remove_file(result.join("result.json")).unwrap();
    let half = error(&result);
    assert!(
        half.contains("video.npy, but no result.json") && half.contains("was killed"),
        "{half}"
    );
    assert!(error(&base.path().join("outside.txt")).contains("outside.txt"));
    // A video of its own is one.
    assert!(ResultFiles::open(&result.join("video.npy")).is_ok());
}

#[test]
fn a_running_reconstruction_is_watched_and_stopped() {
    let stop = Arc::new(AtomicBool::new(false));
    let start = LiveStart {
        title: "run".into(),
        shape: [2, 3, 4],
        axes: VideoAxes::of_frame(9.6, None),
    };
    let live = Arc::new(Live::new(start, Arc::clone(&stop)));
    let server = Server::start(Some(0), Vec::new(), Some(Arc::clone(&live))).unwrap();
    let (_, view) = get(&server, "/api/view");
    let view: serde_json::Value = serde_json::from_slice(&view).unwrap();
    assert_eq!(
        (&view["live"], &view["results"][0]["shape"][2]),
        (&true.into(), &4.into())
    );
    assert!(!live.is_video_requested());
    let state =
        || -> serde_json::Value { serde_json::from_slice(&get(&server, "/api/live").1).unwrap() };
    assert_eq!(state()["snapshot"], 0);
    assert!(live.is_video_requested());
    let point = ProgressPoint {
        iteration: 1,
        max_iterations: 300,
        seconds: 0.5,
        residual_over_sigma: 7.0,
        psnr_db: None,
    };
    live.point("group", point);
    live.show(&[2.0; 24]);
    assert!(!live.is_video_requested());
    let now = state();
    assert_eq!(
        (&now["stage"], &now["snapshot"], &now["label"]),
        (&"running".into(), &1.into(), &"group".into())
    );
    assert_eq!(now["course"][0][2], 7.0);
    let (head, video) = get(&server, "/api/live/bins");
    assert!(head.contains("x-range: 0 2") && video.len() == 48, "{head}");

    let (head, _) = get(&server, "/api/live/stop");
    assert!(head.starts_with("http/1.1 405"), "{head}");
    let cookie = cookie(&server);
    let post = |origin: &str| {
        let request = format!(
            "POST /api/live/stop HTTP/1.1\r\nHost: localhost:1\r\nOrigin: {origin}\r\n{cookie}Content-Length: 0\r\nConnection: close\r\n\r\n"
        );
        ask(&server, &request).0
    };
    assert!(post("http://localhost:2").starts_with("http/1.1 403"));
    assert!(!stop.load(Ordering::Relaxed));
    assert!(post("http://localhost:1").starts_with("http/1.1 204"));
    assert!(stop.load(Ordering::Relaxed));
    assert_eq!(state()["stage"], "stopping");

    let base = folder();
    server.show(vec![
        ResultFiles::open(&base.path().join("result")).unwrap(),
    ]);
    live.set_status(RunStatus::Done);
    assert_eq!(state()["stage"], "done");
    let (_, view) = get(&server, "/api/view");
    let view: serde_json::Value = serde_json::from_slice(&view).unwrap();
    assert_eq!(
        (&view["live"], &view["results"][0]["shape"][2]),
        (&false.into(), &5.into())
    );
}

#[test]
fn a_result_that_is_written_again_is_not_mixed_with_the_one_before() {
    let base = folder();
    let server = served(base.path());
    let bins = "/api/result/0/bins/video?from=0&to=1";
    assert!(get(&server, bins).0.starts_with("http/1.1 200"));
    let out = OutputFolder::create(&base.path().join("result")).unwrap();

    // As rowburst reconstruct does it: result.json goes first, and comes last.
    out.remove("result.json").unwrap();
    for path in [bins, "/api/view"] {
        let (head, body) = get(&server, path);
        assert!(head.starts_with("http/1.1 409"), "{path}: {head}");
        let words = String::from_utf8(body).unwrap();
        assert!(words.contains("result"), "{path}: {words}");
    }
    let video = Video::new(Shape::new(2, 4, 5), vec![7.0; 40]).unwrap();
    out.write("video.npy", |w| write_npy_video(w, &video))
        .unwrap();
    out.write_bytes("result.json", br#"{"frame_rate_hz": 50000.0}"#)
        .unwrap();
    let (head, body) = get(&server, bins);
    assert!(head.starts_with("http/1.1 409"), "{head}");
    assert!(String::from_utf8(body).unwrap().contains("reload"));

    // A reload opens it.
    let (_, meta) = get(&server, "/api/view");
    let meta: serde_json::Value = serde_json::from_slice(&meta).unwrap();
    assert_eq!(meta["results"][0]["shape"][0], 2);
    assert_eq!(meta["results"][0]["bin_duration_us"], 20.0);
    assert!(get(&server, bins).0.starts_with("http/1.1 200"));
}
