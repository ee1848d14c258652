//! The server: routes, and the thread that it lives on.

use crate::guard::{Token, guard};
use crate::live::Live;
use crate::monitor::{Monitor, MonitorRequest};
use crate::page;
use crate::result_files::ResultFiles;
use axum::body::{Body, Bytes};
use axum::extract::{Path, Query, State};
use axum::http::{HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::GracefulShutdown;
use hyper_util::service::TowerToHyperService;
use rowburst::error::Subject;
use rowburst::{Error, Parameter, Result, phrase};
use serde::Deserialize;
use serde_json::json;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;
use tokio::net::TcpStream;
use tokio::sync::{Notify, Semaphore};
use tokio_io_timeout::TimeoutStream;

/// Ports that are tried, from this one on, where none was asked for.
const FIRST_PORT: u16 = 8787;
const PORTS: u16 = 20;
/// Most bytes of one answer: a page asks for a few bins at a time.
const MAX_BYTES: usize = 64 << 20;
/// Connections at once; more wait until one ends.
const MAX_CONNECTIONS: usize = 64;
/// Time in which a client sends the head of a request, also of the next one on its connection.
const HEAD_TIME: Duration = Duration::from_secs(5);
/// Time in which a client takes a part of an answer.
const WRITE_TIME: Duration = Duration::from_secs(30);
/// Answers that are being made at once; each holds its bins in memory.
const MAX_CONCURRENT_ANSWERS: usize = 4;

struct ServerState {
    results: RwLock<Arc<Vec<ResultFiles>>>,
    live: Option<Arc<Live>>,
    monitor: Option<Arc<Monitor>>,
    turns: Semaphore,
}

/// A server that runs on a thread of its own until it is stopped or the program ends.
pub struct Server {
    address: SocketAddr,
    token: Token,
    shared: Arc<ServerState>,
    stop: Arc<Notify>,
}

impl Server {
    /// Listens on 127.0.0.1. Without a `port` it takes 8787, or one of the next that is free; port
    /// 0 is any. `live` is a run that is going on: its result is shown with [`Server::show`].
    ///
    /// # Errors
    /// No port that is free.
    pub fn start(
        port: Option<u16>,
        results: Vec<ResultFiles>,
        live: Option<Arc<Live>>,
    ) -> Result<Self> {
        Self::listen(port, results, live, None)
    }

    /// Like [`Server::start`], for a camera that is looked at.
    ///
    /// # Errors
    /// Those of [`Server::start`].
    pub fn start_monitor(port: Option<u16>, monitor: Arc<Monitor>) -> Result<Self> {
        Self::listen(port, Vec::new(), None, Some(monitor))
    }

    fn listen(
        port: Option<u16>,
        results: Vec<ResultFiles>,
        live: Option<Arc<Live>>,
        monitor: Option<Arc<Monitor>>,
    ) -> Result<Self> {
        let failed = |reason: std::io::Error| {
            let subject = port.map_or(Subject::named("the viewer's server"), |p| {
                Subject::item(Parameter::Port, format!("port {p}"))
            });
            let remedy = phrase!["Choose another port (", Parameter::Port, ")."];
            Error::work(subject, reason, remedy)
        };
        let ports = port.map_or(FIRST_PORT..=FIRST_PORT + PORTS, |p| p..=p);
        let mut last = None;
        let listener = ports
            .filter_map(|port| {
                std::net::TcpListener::bind((Ipv4Addr::LOCALHOST, port))
                    .map_err(|error| last = Some(error))
                    .ok()
            })
            .next();
        let Some(listener) = listener else {
            return Err(failed(last.expect("a port was tried")));
        };
        listener.set_nonblocking(true).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let shared = Arc::new(ServerState {
            results: RwLock::new(Arc::new(results)),
            live,
            monitor,
            turns: Semaphore::new(MAX_CONCURRENT_ANSWERS),
        });
        let token = Token::new(address.port()).map_err(|e| failed(std::io::Error::other(e)))?;
        let routes = routes(Arc::clone(&shared), token.clone());
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()
            .map_err(failed)?;
        let stop = Arc::new(Notify::new());
        let stopped = Arc::clone(&stop);
        std::thread::spawn(move || {
            let served = runtime.block_on(async {
                let listener = tokio::net::TcpListener::from_std(listener)?;
                serve(listener, routes, &stopped).await;
                Ok::<(), std::io::Error>(())
            });
            if let Err(error) = served {
                eprintln!("the viewer's server stopped: {error}");
            }
        });
        Ok(Self {
            address,
            token,
            shared,
            stop,
        })
    }

    /// Ends the server, once the answers that are being made are sent.
    pub fn stop(&self) {
        self.stop.notify_one();
    }

    /// What to open in a browser: the address with the token, without which no request is answered.
    pub fn url(&self) -> String {
        format!("http://{}/?{}", self.address, self.token.query())
    }

    /// From now on these results are shown.
    pub fn show(&self, results: Vec<ResultFiles>) {
        let mut shown = self.shared.results.write();
        *shown.as_deref_mut().expect("no reader panics") = Arc::new(results);
    }
}

impl ServerState {
    fn results(&self) -> Arc<Vec<ResultFiles>> {
        let results = self.results.read();
        Arc::clone(&results.unwrap_or_else(PoisonError::into_inner))
    }

    /// Opens those results anew that were written since they were opened.
    fn renew(&self) -> Result<()> {
        let results = self.results();
        if results.iter().all(|result| result.is_current()) {
            return Ok(());
        }
        let renewed = results
            .iter()
            .map(|result| ResultFiles::open(result.path()));
        let renewed = Arc::new(renewed.collect::<Result<Vec<_>>>()?);
        *self.results.write().unwrap_or_else(PoisonError::into_inner) = renewed;
        Ok(())
    }
}

/// Accepts connections until `stop`, then finishes the answers that are being made.
async fn serve(listener: tokio::net::TcpListener, routes: Router, stop: &Notify) {
    let mut http = hyper::server::conn::http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(HEAD_TIME);
    let graceful = GracefulShutdown::new();
    let connections = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    loop {
        let accept = async {
            let permit = Arc::clone(&connections).acquire_owned().await;
            (permit, listener.accept().await)
        };
        let (permit, stream) = tokio::select! {
            accepted = accept => accepted,
            () = stop.notified() => break,
        };
        let Ok((stream, _)) = stream else {
            // Out of file descriptors: some connection will end.
            tokio::time::sleep(Duration::from_millis(50)).await;
            continue;
        };
        let service = TowerToHyperService::new(routes.clone());
        let connection = http.serve_connection(TokioIo::new(timed(stream)), service);
        let connection = graceful.watch(connection);
        tokio::spawn(async move {
            // A client that goes away, or is too slow, is no fault of the server.
            let _ = connection.await;
            drop(permit);
        });
    }
    graceful.shutdown().await;
}

/// `stream`, which fails where the client takes nothing for [`WRITE_TIME`].
fn timed(stream: TcpStream) -> std::pin::Pin<Box<TimeoutStream<TcpStream>>> {
    let mut stream = TimeoutStream::new(stream);
    stream.set_write_timeout(Some(WRITE_TIME));
    Box::pin(stream)
}

fn routes(shared: Arc<ServerState>, token: Token) -> Router {
    Router::new()
        .route("/", get(index))
        .route("/{file}", get(page_asset))
        .route("/api/view", get(view))
        .route("/api/result/{at}/bins/{name}", get(bins))
        .route("/api/result/{at}/image/{name}", get(image))
        .route("/api/result/{at}/file/{name}", get(file))
        .route("/api/live", get(live))
        .route("/api/live/bins", get(live_bins))
        .route("/api/live/stop", post(stop))
        .route("/api/monitor", get(monitor))
        .route("/api/monitor/frame", get(monitor_frame))
        .route("/api/monitor/bins", get(monitor_bins))
        .route("/api/monitor/request/{name}", post(monitor_request))
        .route("/api/monitor/set/{name}/{value}", post(monitor_set))
        .layer(axum::middleware::from_fn_with_state(token, guard))
        .with_state(shared)
}

const RANGE: HeaderName = HeaderName::from_static("x-range");
const SINCE_FRAME_MS: HeaderName = HeaderName::from_static("x-since-frame-ms");
const SHAPE: HeaderName = HeaderName::from_static("x-shape");

/// Where a result was written anew, its parts would not fit those that a page has.
fn result_changed(result: &ResultFiles) -> Response {
    let words = format!(
        "{} has changed or is being written: reload the page when it is complete.\n",
        result.meta()["name"].as_str().unwrap_or("The result")
    );
    (StatusCode::CONFLICT, words).into_response()
}

fn not_found() -> Response {
    (StatusCode::NOT_FOUND, "There is nothing of this name.\n").into_response()
}

fn binary(
    bytes: impl Into<Bytes>,
    headers: impl IntoIterator<Item = (HeaderName, String)>,
) -> Response {
    let mut response = bytes.into().into_response();
    for (name, value) in headers {
        let value = value.parse().expect("numbers are fit for a header");
        response.headers_mut().insert(name, value);
    }
    response
}

async fn index() -> Response {
    page_file("index.html")
}

async fn page_asset(Path(name): Path<String>) -> Response {
    page_file(&name)
}

fn page_file(name: &str) -> Response {
    match page::file(name) {
        Some((kind, text)) => ([(header::CONTENT_TYPE, kind)], text).into_response(),
        None => not_found(),
    }
}

async fn view(State(shared): State<Arc<ServerState>>) -> Response {
    if let Err(error) = shared.renew() {
        return (StatusCode::CONFLICT, format!("{error}\n")).into_response();
    }
    let results = shared.results();
    let metas: Vec<_> = match &shared.live {
        Some(live) if results.is_empty() => vec![live.meta()],
        _ => results.iter().map(|r| r.meta().clone()).collect(),
    };
    if let Some(monitor) = &shared.monitor {
        let metas = [monitor.meta()];
        return Json(json!({ "live": true, "monitor": true, "results": metas })).into_response();
    }
    let running = shared.live.is_some() && results.is_empty();
    Json(json!({ "live": running, "results": metas })).into_response()
}

#[derive(Deserialize)]
struct Range {
    from: usize,
    to: usize,
}

/// Bins `from..to` as 16-bit numbers, with their scale in `X-Range`.
async fn bins(
    State(shared): State<Arc<ServerState>>,
    Path((at, name)): Path<(usize, String)>,
    Query(Range { from, to }): Query<Range>,
) -> Response {
    let results = shared.results();
    let Some((result, array)) = results.get(at).and_then(|r| Some((r, r.array(&name)?))) else {
        return not_found();
    };
    if !result.is_current() {
        return result_changed(result);
    }
    let count = array.shape()[0];
    let max_bins = MAX_BYTES / array.bytes_per_bin().max(1);
    if from >= to || to > count || to - from > max_bins.max(1) {
        let words = format!(
            "bins {from} to {to}: the video has {count}, and one request may ask for up to {}\n",
            max_bins.max(1)
        );
        return (StatusCode::BAD_REQUEST, words).into_response();
    }
    let name = name.clone();
    let results = Arc::clone(&results);
    work(&shared, move || {
        let array = results[at].array(&name).expect("found before");
        let found = array.bins(from, to);
        // It may have been replaced while it was read.
        if !results[at].is_current() {
            return Ok(result_changed(&results[at]));
        }
        let found = found?;
        let (low, high) = found.range;
        Ok(binary(found.bytes, [(RANGE, format!("{low} {high}"))]))
    })
    .await
}

/// A picture as float32, with its size in `X-Shape`.
async fn image(
    State(shared): State<Arc<ServerState>>,
    Path((at, name)): Path<(usize, String)>,
) -> Response {
    let results = shared.results();
    let found = results.get(at).and_then(|r| Some((r, r.image(&name)?)));
    let Some(path) = found.map(|(_, path)| path.to_path_buf()) else {
        return not_found();
    };
    let results = Arc::clone(&results);
    work(&shared, move || {
        let image = rowburst_io::read_image(&path);
        if !results[at].is_current() {
            return Ok(result_changed(&results[at]));
        }
        let image = image?.image;
        let bytes: Vec<u8> = image.data().iter().flat_map(|v| v.to_le_bytes()).collect();
        let size = format!("{} {}", image.rows(), image.columns());
        Ok(binary(bytes, [(SHAPE, size)]))
    })
    .await
}

/// Runs blocking work when it is its turn.
async fn work(
    shared: &ServerState,
    job: impl FnOnce() -> Result<Response> + Send + 'static,
) -> Response {
    let _turn = shared.turns.acquire().await;
    match tokio::task::spawn_blocking(job).await {
        Ok(Ok(response)) => response,
        Ok(Err(error)) => (StatusCode::INTERNAL_SERVER_ERROR, format!("{error}\n")).into_response(),
        Err(_) => (StatusCode::INTERNAL_SERVER_ERROR, "The work failed.\n").into_response(),
    }
}

async fn file(
    State(shared): State<Arc<ServerState>>,
    Path((at, name)): Path<(usize, String)>,
) -> Response {
    let results = shared.results();
    let Some((path, kind)) = results.get(at).and_then(|r| r.download(&name)) else {
        return not_found();
    };
    let Ok(file) = tokio::fs::File::open(path).await else {
        return not_found();
    };
    let Ok(metadata) = file.metadata().await else {
        return not_found();
    };
    let headers = [
        (header::CONTENT_TYPE, kind.to_string()),
        (header::CONTENT_LENGTH, metadata.len().to_string()),
        (
            header::CONTENT_DISPOSITION,
            format!("attachment; filename=\"{name}\""),
        ),
    ];
    let body = Body::from_stream(tokio_util::io::ReaderStream::new(file));
    (headers, body).into_response()
}

async fn live(State(shared): State<Arc<ServerState>>) -> Response {
    match &shared.live {
        Some(live) => Json(live.state()).into_response(),
        None => not_found(),
    }
}

async fn live_bins(State(shared): State<Arc<ServerState>>) -> Response {
    match shared.live.as_ref().and_then(|live| live.video()) {
        Some((bytes, (low, high))) => binary(bytes, [(RANGE, format!("{low} {high}"))]),
        None => not_found(),
    }
}

async fn stop(State(shared): State<Arc<ServerState>>) -> Response {
    match &shared.live {
        Some(live) => {
            live.ask_to_stop();
            StatusCode::NO_CONTENT.into_response()
        }
        None => not_found(),
    }
}

async fn monitor(State(shared): State<Arc<ServerState>>) -> Response {
    match &shared.monitor {
        Some(monitor) => Json(monitor.state()).into_response(),
        None => not_found(),
    }
}

/// The latest frame as 16-bit counts, with its size in `X-Shape`.
async fn monitor_frame(State(shared): State<Arc<ServerState>>) -> Response {
    match shared.monitor.as_ref().and_then(|monitor| monitor.frame()) {
        Some((bytes, (rows, columns))) => binary(bytes, [(SHAPE, format!("{rows} {columns}"))]),
        None => not_found(),
    }
}

async fn monitor_bins(State(shared): State<Arc<ServerState>>) -> Response {
    match shared.monitor.as_ref().and_then(|monitor| monitor.video()) {
        Some(video) => {
            let (low, high) = video.range;
            let since_frame_ms = video.arrived.elapsed().as_secs_f64() * 1e3;
            let headers = [
                (RANGE, format!("{low} {high}")),
                (SINCE_FRAME_MS, since_frame_ms.to_string()),
            ];
            binary(video.bytes, headers)
        }
        None => not_found(),
    }
}

async fn monitor_request(
    State(shared): State<Arc<ServerState>>,
    Path(name): Path<String>,
) -> Response {
    ask_monitor(&shared, MonitorRequest::from_name(&name))
}

async fn monitor_set(
    State(shared): State<Arc<ServerState>>,
    Path((name, value)): Path<(String, f64)>,
) -> Response {
    let request = value
        .is_finite()
        .then_some(MonitorRequest::Set { name, value });
    ask_monitor(&shared, request)
}

fn ask_monitor(shared: &ServerState, request: Option<MonitorRequest>) -> Response {
    let asked = shared.monitor.as_ref().zip(request);
    match asked.map(|(monitor, request)| monitor.request(request)) {
        Some(true) => StatusCode::NO_CONTENT.into_response(),
        Some(false) => {
            let words = "Earlier requests still wait: try again.\n";
            (StatusCode::TOO_MANY_REQUESTS, words).into_response()
        }
        None => not_found(),
    }
}
