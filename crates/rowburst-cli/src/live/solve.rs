//! The video of the latest frame, begun from that of the one before.

use super::WAIT;
use super::grab::Latest;
use rowburst::reconstruct::{Model, Options, Sequence};
use rowburst::solve::StopReason;
use rowburst::{Cancel, Result};
use rowburst_capture::Frame;
use rowburst_run::{Bias, Frame as RawFrame, Setup};
use rowburst_view::Monitor;
use serde_json::json;
use std::ops::ControlFlow;
use std::time::{Duration, Instant};

/// Videos over which the rate is averaged.
const RATE_VIDEOS: usize = 10;

pub struct LiveSolver {
    setup: Setup,
    sequence: Sequence,
    budget: Option<Duration>,
    /// When the last videos were shown.
    shown: Vec<Instant>,
}

impl LiveSolver {
    /// Sets up the model; `first` must fit the experiment.
    pub fn new(setup: Setup, budget: Option<Duration>, first: &Frame) -> Result<Self> {
        let options = Options {
            is_preview: true,
            ..setup.options
        };
        rowburst_run::check_memory(
            setup
                .experiment
                .as_deref()
                .unwrap_or(std::path::Path::new("")),
            &setup.camera,
            Model::cached_gram_bytes(&setup.camera),
        )?;
        setup.measurement(&raw(first)?)?;
        let model = Model::new(&setup.camera, &setup.psfs)
            .with_cancel(&setup.cancel)
            .with_cached_gram();
        Ok(Self {
            sequence: Sequence::new(model, options),
            setup,
            budget,
            shown: Vec::new(),
        })
    }

    /// Waits for a frame and shows its video. A frame that fails is told on the page, and the next one is tried.
    pub fn step(&mut self, latest: &Latest, monitor: &Monitor, cancel: &Cancel) {
        let Some((frame, arrived)) = latest.take(WAIT) else {
            return;
        };
        if let Err(error) = self.solve(&frame, arrived, monitor, cancel) {
            monitor.set("error", error.to_string());
        }
    }

    fn solve(
        &mut self,
        frame: &Frame,
        arrived: Instant,
        monitor: &Monitor,
        cancel: &Cancel,
    ) -> Result<()> {
        let began = Instant::now();
        let measurement = self.setup.measurement(&raw(frame)?)?;
        let budget = self.budget;
        let (found, is_warm) = self.sequence.reconstruct(&measurement, &mut |_| {
            if cancel.is_cancelled() {
                ControlFlow::Break(StopReason::Interrupted)
            } else if budget.is_some_and(|budget| began.elapsed() > budget) {
                ControlFlow::Break(StopReason::TimeBudget)
            } else {
                ControlFlow::Continue(())
            }
        })?;
        monitor.show_video(found.video.data(), arrived);
        monitor.set("error", serde_json::Value::Null);
        monitor.set(
            "video",
            json!({
                "number": frame.number,
                "latency_ms": arrived.elapsed().as_secs_f64() * 1e3,
                "solver_ms": began.elapsed().as_secs_f64() * 1e3,
                "videos_per_second": self.rate(),
                "iterations": found.iterations,
                "residual_over_sigma": found.residual_over_sigma,
                "warm_start": is_warm,
                "fit": found.fit.verdict.name(),
            }),
        );
        Ok(())
    }

    /// Videos a second, of the last ones.
    fn rate(&mut self) -> Option<f64> {
        self.shown.push(Instant::now());
        if self.shown.len() > RATE_VIDEOS {
            self.shown.remove(0);
        }
        let seconds = self.shown.last()?.duration_since(*self.shown.first()?);
        let steps = self.shown.len() - 1;
        (steps > 0).then(|| steps as f64 / seconds.as_secs_f64())
    }
}

fn raw(frame: &Frame) -> Result<RawFrame> {
    Ok(RawFrame {
        capture: frame.capture()?,
        bias: Bias::Contained,
        file: None,
    })
}
