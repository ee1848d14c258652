//! A camera that is looked at: the latest frame, how well it is exposed, the latest video, and what the page asks for.
//!
//! The threads of the camera and of the solver write, the server's threads read. Nothing waits for the page: a frame
//! or a video that a page has not fetched is replaced by the next.

use crate::VideoAxes;
use crate::array::QuantisedBins;
use axum::body::Bytes;
use serde_json::{Map, Value, json};
use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// Requests that wait at most; more are refused.
const MAX_REQUESTS: usize = 8;

/// What is known before the first frame.
#[derive(Debug, Clone)]
pub struct MonitorStart {
    /// Title of the page: the source.
    pub title: String,
    /// Bins, rows and columns of the video; one bin of the frame's size where nothing is reconstructed.
    pub shape: [usize; 3],
    /// Units of the axes.
    pub axes: VideoAxes,
    /// Whether frames are reconstructed.
    pub reconstructs: bool,
}

/// What a page asks for.
#[derive(Debug, Clone, PartialEq)]
pub enum MonitorRequest {
    /// Begin a recording.
    Record,
    /// End it.
    Stop,
    /// Keep the latest frame.
    Snapshot,
    /// Keep the latest frame and reconstruct it in full.
    Save,
    /// Set a control of the camera.
    Set {
        /// Its name.
        name: String,
        /// The value that is asked for.
        value: f64,
    },
}

impl MonitorRequest {
    /// The request of a name in an address.
    pub(crate) fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "record" => Self::Record,
            "stop" => Self::Stop,
            "snapshot" => Self::Snapshot,
            "save" => Self::Save,
            _ => return None,
        })
    }

    /// Whether `other`, which is later, takes its place: of a slider that moves only the last value matters.
    fn is_replaced_by(&self, other: &Self) -> bool {
        matches!((self, other), (Self::Set { name: a, .. }, Self::Set { name: b, .. }) if a == b)
    }
}

/// A camera as the page sees it.
pub struct Monitor {
    start: MonitorStart,
    state: Mutex<MonitorState>,
}

#[derive(Default)]
struct MonitorState {
    /// Numbers and words by name, as `/api/monitor` gives them.
    values: Map<String, Value>,
    frame: Option<(Bytes, (usize, usize))>,
    frame_snapshot: usize,
    video: Option<ShownVideo>,
    video_snapshot: usize,
    requests: VecDeque<MonitorRequest>,
}

/// The latest video.
#[derive(Clone)]
pub(crate) struct ShownVideo {
    /// All its bins, as the page takes them.
    pub bytes: Bytes,
    /// The values of the smallest and the largest number.
    pub range: (f32, f32),
    /// When its frame arrived.
    pub arrived: Instant,
}

impl Monitor {
    /// A monitor without frames.
    pub fn new(start: MonitorStart) -> Self {
        Self {
            start,
            state: Mutex::default(),
        }
    }

    /// Sets a value of the state by its name.
    pub fn set(&self, name: &str, value: impl Into<Value>) {
        self.lock().values.insert(name.into(), value.into());
    }

    /// Shows a raw frame.
    pub fn show_frame(&self, size: (usize, usize), counts: &[u16]) {
        let bytes: Vec<u8> = counts
            .iter()
            .flat_map(|count| count.to_le_bytes())
            .collect();
        let mut state = self.lock();
        state.frame = Some((bytes.into(), size));
        state.frame_snapshot += 1;
    }

    /// Shows a video `[t, y, x]`, whose frame arrived at `arrived`.
    ///
    /// # Panics
    /// If it has not the shape that was announced.
    pub fn show_video(&self, video: &[f32], arrived: Instant) {
        let voxels: usize = self.start.shape.iter().product();
        assert_eq!(video.len(), voxels, "the shape that was announced");
        let QuantisedBins { bytes, range } = QuantisedBins::of(video);
        let bytes = bytes.into();
        let mut state = self.lock();
        state.video = Some(ShownVideo {
            bytes,
            range,
            arrived,
        });
        state.video_snapshot += 1;
    }

    /// The oldest request that has not been answered.
    pub fn take_request(&self) -> Option<MonitorRequest> {
        self.lock().requests.pop_front()
    }

    /// Adds a request; `false` where too many wait.
    pub(crate) fn request(&self, request: MonitorRequest) -> bool {
        let mut state = self.lock();
        state
            .requests
            .retain(|earlier| !earlier.is_replaced_by(&request));
        let has_room = state.requests.len() < MAX_REQUESTS;
        if has_room {
            state.requests.push_back(request);
        }
        has_room
    }

    /// Everything but the pictures.
    pub(crate) fn state(&self) -> Value {
        let state = self.lock();
        let mut values = state.values.clone();
        values.insert("frame_snapshot".into(), state.frame_snapshot.into());
        values.insert("video_snapshot".into(), state.video_snapshot.into());
        values.insert("reconstructs".into(), self.start.reconstructs.into());
        Value::Object(values)
    }

    pub(crate) fn frame(&self) -> Option<(Bytes, (usize, usize))> {
        self.lock().frame.clone()
    }

    pub(crate) fn video(&self) -> Option<ShownVideo> {
        self.lock().video.clone()
    }

    /// As that of a result.
    pub(crate) fn meta(&self) -> Value {
        json!({
            "name": self.start.title, "images": {}, "files": [], "ranges": {},
            "shape": self.start.shape, "bin_duration_us": self.start.axes.bin_duration_us,
            "view": self.start.axes.view(&self.start.title),
            "result": null,
        })
    }

    // What is behind the lock is whole after every statement.
    fn lock(&self) -> MutexGuard<'_, MonitorState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_are_taken_in_order_and_limited() {
        let monitor = Monitor::new(MonitorStart {
            title: "play:a".into(),
            shape: [1, 2, 2],
            axes: VideoAxes::of_frame(10.0, None),
            reconstructs: false,
        });
        assert!(monitor.request(MonitorRequest::Record) && monitor.request(MonitorRequest::Stop));
        assert_eq!(monitor.take_request(), Some(MonitorRequest::Record));
        assert_eq!(monitor.take_request(), Some(MonitorRequest::Stop));
        assert_eq!(monitor.take_request(), None);
        let taken = (0..20)
            .filter(|_| monitor.request(MonitorRequest::Save))
            .count();
        assert_eq!(taken, MAX_REQUESTS);
        while monitor.take_request().is_some() {}
        let set = |value| MonitorRequest::Set {
            name: "Gain".into(),
            value,
        };
        assert!((0..50).all(|n| monitor.request(set(f64::from(n)))));
        assert_eq!(monitor.take_request(), Some(set(49.0)));
        assert_eq!(monitor.take_request(), None);
        monitor.show_frame((2, 2), &[0, 1, 256, 65_535]);
        assert_eq!(monitor.state()["frame_snapshot"], 1);
        assert_eq!(monitor.frame().unwrap().0[..], [0, 0, 1, 0, 0, 1, 255, 255]);
    }
}
