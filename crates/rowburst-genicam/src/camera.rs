//! A camera: how it is found and opened, and its frames.

use crate::delivery::Sequence;
use crate::features;
use rowburst::error::Subject;
use rowburst::{Cancel, Error, ErrorKind, Result};
use rowburst_capture::{Control, Delivery, Settings, Source};
use std::collections::VecDeque;
use std::net::Ipv4Addr;
use std::time::{Duration, Instant};
use viva_genicam::gige::{DeviceInfo, DiscoveryOptions};
use viva_genicam::{
    Camera, ControlState, FrameStream, GenicamError, GigeRegisterIo, StreamOptions, blocking,
};

/// Time in which cameras answer.
const DISCOVERY_TIME: Duration = Duration::from_secs(1);

/// Longest wait before Ctrl-C is looked for.
const PATIENCE: Duration = Duration::from_millis(50);

/// Silence after which the camera is asked whether it is there: a camera that waits for a trigger answers.
const SILENCE: Duration = Duration::from_secs(1);

/// A camera on the network.
pub struct GenicamCamera {
    name: String,
    /// Manufacturer, model and serial number.
    identity: String,
    camera: Camera<GigeRegisterIo>,
    /// The frames, once they were asked for.
    stream: Option<FrameStream>,
    sequence: Sequence,
    /// Deliveries that came together with one before.
    waiting: VecDeque<Delivery>,
    is_unreachable: bool,
}

/// The cameras that answer: the name of the source and what it is.
pub fn list() -> Result<Vec<(String, String)>> {
    let found = discover("the network")?;
    let names = found
        .iter()
        .map(|device| (format!("genicam:{}", device.ip), identity(device)));
    Ok(names.collect())
}

fn discover(name: &str) -> Result<Vec<DeviceInfo>> {
    let options = DiscoveryOptions::new().include_loopback(true);
    blocking::discover_with(DISCOVERY_TIME, &options).map_err(|error| {
        let remedy = "Check that the network is up.";
        fault(name, &error, remedy)
    })
}

fn identity(device: &DeviceInfo) -> String {
    let parts = [&device.manufacturer, &device.model, &device.serial];
    let parts = parts.into_iter().flatten().map(|part| part.trim());
    parts
        .filter(|part| !part.is_empty())
        .collect::<Vec<_>>()
        .join(" ")
}

/// The camera at an address, or the one with this serial number or name.
fn find(address: &str) -> Result<DeviceInfo> {
    let name = format!("genicam:{address}");
    let found = match address.parse::<Ipv4Addr>() {
        Ok(ip) => blocking::discover_ip(ip, DISCOVERY_TIME)
            .map_err(|error| fault(&name, &error, "Check the address and the cable."))?,
        Err(_) if address.trim().is_empty() => None,
        Err(_) => discover(&name)?.into_iter().find(|device| {
            let names = [&device.serial, &device.user_name];
            names
                .into_iter()
                .flatten()
                .any(|known| known.trim() == address.trim())
        }),
    };
    found.ok_or_else(|| {
        Error::input(
            Subject::named(name),
            "no answer",
            "a source is genicam:ADDRESS or genicam:SERIAL of a camera that is switched on and in the same network",
            "List the cameras that answer: rowburst capture list. Check cable, power, firewall and the address's network.",
        )
        .with_kind(ErrorKind::NotFound)
    })
}

impl GenicamCamera {
    /// Opens the camera at an IPv4 address, or the one with a serial number or name.
    ///
    /// # Errors
    /// No camera that answers, or one that another program controls.
    pub fn open(address: &str) -> Result<Self> {
        let name = format!("genicam:{address}");
        let device = find(address)?;
        let camera = blocking::connect(&device)
            .map_err(|error| fault(&name, &error, "Close other programs that use the camera."))?;
        Ok(Self {
            sequence: Sequence::new(features::ticks_per_second(&camera)),
            identity: identity(&device),
            name,
            camera,
            stream: None,
            waiting: VecDeque::new(),
            is_unreachable: false,
        })
    }

    /// Begins the acquisition where it does not run.
    fn start(&mut self) -> Result<()> {
        if self.stream.is_some() {
            return Ok(());
        }
        let failed = |name: &str, error: &GenicamError| {
            fault(
                name,
                error,
                "Close other programs that use the camera, and check its trigger settings.",
            )
        };
        features::acquire_continuously(&mut self.camera)
            .map_err(|error| failed(&self.name, &error))?;
        let stream = self.camera.open_stream(StreamOptions::new());
        let mut stream = stream.map_err(|error| failed(&self.name, &error))?;
        stream.set_deliver_incomplete(true);
        self.camera
            .acquisition_start()
            .map_err(|error| failed(&self.name, &error))?;
        self.stream = Some(stream);
        Ok(())
    }

    /// The next block within `patience`; `None` where none arrived.
    fn take(&mut self, patience: Duration) -> Result<Option<()>> {
        let Some(stream) = &mut self.stream else {
            return Ok(None);
        };
        match stream.next_frame_blocking(patience) {
            Ok(Some(frame)) => {
                self.waiting.extend(self.sequence.take(&self.name, &frame)?);
                Ok(Some(()))
            }
            Ok(None) => Err(self.lost("its stream has ended")),
            Err(GenicamError::Timeout(_)) => Ok(None),
            Err(error) => Err(self.lost(&error.to_string())),
        }
    }

    /// Asks a silent camera whether it is still there.
    fn check_presence(&mut self) -> Result<()> {
        match self.camera.transport().refresh_control_state() {
            Ok(ControlState::Held) => Ok(()),
            Ok(_) => Err(self.lost("another program has taken control of it")),
            Err(error) => Err(self.lost(&error.to_string())),
        }
    }

    fn lost(&mut self, reason: &str) -> Error {
        self.is_unreachable = true;
        Error::work(
            Subject::named(self.name.clone()),
            format!("the camera does not answer any more: {reason}"),
            "Check cable and power, and begin again; the frames before are kept.",
        )
    }
}

impl Source for GenicamCamera {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn settings(&mut self) -> Result<Settings> {
        let mut settings = Settings {
            source: self.name.clone(),
            camera: (!self.identity.is_empty()).then(|| self.identity.clone()),
            ..Settings::default()
        };
        for (name, value) in features::values(&self.camera) {
            settings.push(name, value);
        }
        settings.mark_unknown();
        Ok(settings)
    }

    fn next(&mut self, cancel: &Cancel) -> Result<Delivery> {
        self.start()?;
        let mut silent_since = Instant::now();
        loop {
            if let Some(delivery) = self.waiting.pop_front() {
                return Ok(delivery);
            }
            cancel.check()?;
            if self.take(PATIENCE)?.is_none() && silent_since.elapsed() > SILENCE {
                self.check_presence()?;
                silent_since = Instant::now();
            }
        }
    }

    fn skip_to_latest(&mut self) -> Result<u64> {
        while self.take(Duration::ZERO)?.is_some() {}
        let before = self.waiting.len();
        let last = self
            .waiting
            .iter()
            .rposition(|d| matches!(d, Delivery::Frame(_)));
        self.waiting.drain(..last.unwrap_or(0));
        Ok((before - self.waiting.len()) as u64)
    }

    fn controls(&mut self) -> Result<Vec<Control>> {
        Ok(features::controls(&self.camera))
    }

    fn set(&mut self, name: &str, value: f64) -> Result<()> {
        let controls = features::controls(&self.camera);
        let Some(control) = controls.iter().find(|control| control.name == name) else {
            let names: Vec<_> = controls.iter().map(|c| c.name.as_str()).collect();
            return Err(Error::input(
                Subject::named(self.name.clone()),
                format!("{name} = {value}"),
                format!("the camera's controls are {}", names.join(", ")),
                "Set it in the camera's own program.",
            )
            .with_kind(ErrorKind::Unknown));
        };
        if !(control.min..=control.max).contains(&value) {
            return Err(Error::input(
                Subject::named(self.name.clone()),
                format!("{name} = {value}"),
                format!("the camera takes {} to {}", control.min, control.max),
                "Choose a value within it.",
            )
            .with_kind(ErrorKind::Invalid));
        }
        features::set(&mut self.camera, name, value).map_err(|error| {
            fault(
                &self.name,
                &error,
                "Check whether the camera sets it by itself (ExposureAuto, GainAuto).",
            )
        })
    }
}

impl Drop for GenicamCamera {
    fn drop(&mut self) {
        // A camera that is gone would only be waited for.
        if self.stream.take().is_some() && !self.is_unreachable {
            let _ = self.camera.acquisition_stop();
        }
    }
}

fn fault(name: &str, error: &GenicamError, remedy: &'static str) -> Error {
    Error::work(Subject::named(name.to_string()), error.to_string(), remedy)
}
