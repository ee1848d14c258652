//! The whole report, on ordinary and on odd inputs.

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use rowburst::design::count::ChangeCount;
use rowburst::traces::{Frequency, Region, Trace, brightest_regions};
use rowburst::{Image, Sensor, Shape, TimeGrid, Video};

use super::*;

/// Values of a reconstruction, owned.
struct Case {
    frame: Image,
    psf: Image,
    video: Video,
    truth: Option<Video>,
    residual: Image,
    instants: Vec<usize>,
    time: TimeGrid,
    sensor: Sensor,
    convergence: Vec<Iteration>,
    traces: Vec<AnnotatedTrace>,
    draws_change: bool,
}

impl Case {
    /// A video of `shape` on a sensor of `rows · columns`: a dim ramp and a moving spot.
    fn new(shape: Shape, rows: usize, columns: usize) -> Self {
        let mut video = Video::zeros(shape);
        for t in 0..shape.bins {
            let at = (t * 7) % shape.pixels();
            video.bin_mut(t)[at] = 5.0;
        }
        let ramp = Image::from_fn(rows, columns, |y, x| ((y * 13 + x * 7) % 11) as f32 - 5.0);
        Self {
            frame: ramp.clone(),
            psf: Image::from_fn(3, 5, |y, x| (y + x) as f32),
            truth: Some(video.clone()),
            traces: traces_of(&video),
            video,
            residual: ramp,
            instants: (0..rows).map(|r| r % shape.bins).collect(),
            time: match shape.bins {
                1 => TimeGrid::single(1000.0),
                bins => TimeGrid::rolling(bins, 9.6, 1.0, 1),
            },
            sensor: Sensor::default(),
            convergence: (1..20)
                .map(|i| Iteration {
                    iteration: i,
                    seconds: 0.01 * i as f64,
                    objective: 1.0 / i as f64,
                    residual_over_sigma: 10.0 / i as f64,
                    change: 0.5_f64.powi(i as i32),
                    psnr_db: None,
                })
                .collect(),
            draws_change: false,
        }
    }

    fn input(&self) -> ReportInput<'_> {
        ReportInput {
            title: "A title",
            frame: &self.frame,
            psf: &self.psf,
            video: &self.video,
            truth: self.truth.as_ref(),
            direct: Some(Direct {
                image: &self.frame,
                origin: DirectOrigin::Truth,
            }),
            residual: &self.residual,
            given_psf: None,
            stray_light: None,
            residual_before: None,
            draws_change: self.draws_change,
            change_count: None,
            excluded: None,
            coverage: None,
            traces: &self.traces,
            instants: &self.instants,
            time: &self.time,
            convergence: &self.convergence,
            headline: Vec::new(),
            fit: None,
            settings: Vec::new(),
            sensor: &self.sensor,
            mp4: None,
            player: None,
            files: Vec::new(),
            reproduce: None,
        }
    }

    fn names(&self) -> Vec<String> {
        let report = render(&self.input()).expect("a report");
        check_page(&report);
        report.pictures.into_iter().map(|p| p.name).collect()
    }
}

/// The brightest places with made-up errors, of which one bin's is not known, a frequency and a
/// photodiode.
fn traces_of(video: &Video) -> Vec<AnnotatedTrace> {
    let place = |region: Region| {
        let mut trace = Trace::without_errors(region, video);
        trace.standard_error = (0..trace.value.len())
            .map(|t| if t == 2 { f64::NAN } else { 0.1 * t as f64 })
            .collect();
        AnnotatedTrace {
            frequency: Some(Frequency {
                hertz: 20_833.0,
                error_hz: 12.0,
                amplitude: 1.0,
                amplitude_error: 0.1,
                share: 0.9,
                is_half_rate: false,
                harmonics: Vec::new(),
            }),
            photodiodes: vec![AlignedSignal {
                name: "diode.csv".into(),
                correlation: 0.99,
                points: (0..90).map(|i| (0.1 * i as f64, (i % 2) as f64)).collect(),
            }],
            is_requested: false,
            trace,
        }
    };
    brightest_regions(video, 6).into_iter().map(place).collect()
}

/// Every picture is a PNG of some size, every data URI too, and nothing is asked for from outside.
fn check_page(report: &Report) {
    for picture in &report.pictures {
        let (width, height) = size(&picture.png);
        assert!(
            (300..=1700).contains(&width) && (50..=2400).contains(&height),
            "{}",
            picture.name
        );
        assert!(!picture.caption.is_empty() && report.html.contains(&picture.name));
    }
    let mut images = 0;
    for piece in report.html.split("data:image/png;base64,").skip(1) {
        let data = piece.split('"').next().expect("the end of an attribute");
        let (width, height) = size(&BASE64_STANDARD.decode(data).expect("base64"));
        assert!(width > 0 && height > 0);
        images += 1;
    }
    assert!(images >= 5);
    for attribute in ["src=\"", "href=\"", "url("] {
        for value in report.html.split(attribute).skip(1) {
            assert!(value.starts_with("data:"), "{attribute}{:.40}", value);
        }
    }
    assert!(report.html.contains("default-src 'none'") && !report.html.contains("<script"));
    let svgs: Vec<&str> = report.html.split("<svg").skip(1).collect();
    assert_eq!(svgs.len(), report.pictures.len());
    assert!(svgs.iter().all(|svg| svg.contains("<title id=")));
    assert!(!report.html.contains("NaN") && !report.html.contains("\"inf"));
}

fn size(png: &[u8]) -> (u32, u32) {
    let mut reader = png::Decoder::new(std::io::Cursor::new(png))
        .read_info()
        .expect("a PNG");
    let mut pixels = vec![0; reader.output_buffer_size().expect("a size")];
    reader.next_frame(&mut pixels).expect("its pixels");
    reader.info().size()
}

/// The bytes of the picture `name` and those of one of its rows.
fn bytes_of(report: &Report, name: &str) -> (Vec<u8>, usize) {
    let png = &picture(report, name).png;
    let mut reader = png::Decoder::new(std::io::Cursor::new(png))
        .read_info()
        .expect("a PNG");
    let mut pixels = vec![0; reader.output_buffer_size().expect("a size")];
    reader.next_frame(&mut pixels).expect("its pixels");
    let row = reader.info().width as usize * 3;
    (pixels, row)
}

/// How many pixels of the picture `name` have this colour.
fn count(report: &Report, name: &str, colour: [u8; 3]) -> usize {
    let (pixels, _) = bytes_of(report, name);
    let is_it = |pixel: &&[u8]| **pixel == colour;
    pixels.chunks_exact(3).filter(is_it).count()
}

fn picture<'a>(report: &'a Report, name: &str) -> &'a Picture {
    let found = report.pictures.iter().find(|p| p.name == name);
    found.expect("the picture")
}

/// The names of the axes are not cut at the left edge of the box, which is dark there.
#[test]
fn labels_of_space_and_time_are_whole() {
    for magnification in [None, Some(0.5)] {
        let mut case = Case::new(Shape::new(20, 24, 30), 24, 30);
        case.sensor.pixel_pitch_um = Some(6.5);
        case.sensor.magnification = magnification;
        let report = render(&case.input()).expect("a report");
        let (pixels, row) = bytes_of(&report, "space-time.png");
        let is_light = |bytes: &&[u8]| bytes[0].min(bytes[1]).min(bytes[2]) > 100;
        // The page is white above and below.
        let rows = pixels.len() / row;
        let edge = pixels.chunks_exact(row).skip(rows / 8).take(3 * rows / 4);
        let light = edge.filter(|bytes| bytes.chunks_exact(3).take(4).any(|p| is_light(&p)));
        assert_eq!(light.count(), 0, "magnification {magnification:?}");
    }
}

#[test]
fn pixels_that_were_left_out_are_yellow() {
    use crate::colour::LEFT_OUT;
    let mut case = Case::new(Shape::new(20, 24, 30), 24, 30);
    let mut mask = vec![0_u8; 24 * 30];
    let left_out = [3, 100, 101, 400];
    left_out.iter().for_each(|&i| mask[i] = 1);
    let masked = |case: &Case| {
        let input = ReportInput {
            excluded: Some(&mask),
            ..case.input()
        };
        let report = render(&input).expect("a report");
        check_page(&report);
        report
    };
    let report = masked(&case);
    // A pixel of the frame is drawn by 33 × 33 pixels, one of the residual by 22 × 22, less the frame about it.
    assert_eq!(count(&report, "frame.png", LEFT_OUT), 4 * 33 * 33);
    let of_residual = count(&report, "residual.png", LEFT_OUT);
    assert!((4 * 20 * 20..=4 * 22 * 22).contains(&of_residual));
    for name in ["frame.png", "residual.png"] {
        let caption = &picture(&report, name).caption;
        assert!(caption.contains("Yellow: 4 pixels (0.56 %)"), "{caption}");
    }
    // What they hold sets no range and is in no histogram.
    for i in left_out {
        case.frame.data_mut()[i] = 1e6;
        case.residual.data_mut()[i] = 1e6;
    }
    let bright = masked(&case);
    for name in ["frame.png", "residual.png"] {
        assert_eq!(picture(&bright, name), picture(&report, name));
    }
    let plain = render(&case.input()).expect("a report");
    assert_eq!(count(&plain, "frame.png", LEFT_OUT), 0);
    assert!(!plain.html.contains("Yellow: "));
}

#[test]
fn voxels_that_the_frame_does_not_observe_are_slate() {
    use crate::colour::UNOBSERVED;
    for bins in [20, 1] {
        let mut case = Case::new(Shape::new(bins, 24, 30), 24, 30);
        let mut coverage = vec![1_u8; bins * 24 * 30];
        // The last row of every bin.
        coverage
            .chunks_exact_mut(24 * 30)
            .for_each(|bin| bin[23 * 30..].fill(0));
        for has_truth in [true, false] {
            if !has_truth {
                case.truth = None;
            }
            let input = ReportInput {
                coverage: Some(&coverage),
                ..case.input()
            };
            let report = render(&input).expect("a report");
            check_page(&report);
            let name = match bins {
                1 => "reconstruction.png",
                _ => "frames.png",
            };
            let plain = render(&case.input()).expect("a report");
            let marked = |report| count(report, name, UNOBSERVED);
            assert!(marked(&report) > 30 && marked(&plain) == 0, "{bins}");
            let sentence = "The frame does not observe 4.2 % of the voxels; they are zero (slate";
            assert!(picture(&report, name).caption.contains(sentence));
            assert!(!plain.html.contains("does not observe"));
        }
    }
}

#[test]
fn an_ordinary_case_has_all_pictures() {
    let case = Case::new(Shape::new(20, 24, 30), 24, 30);
    let expected = "time-colour space-time frames traces frame psf direct residual convergence";
    let expected: Vec<String> = expected.split(' ').map(|n| format!("{n}.png")).collect();
    assert_eq!(case.names(), expected);
}

#[test]
fn a_single_bin_is_shown_large() {
    let mut case = Case::new(Shape::new(1, 24, 30), 24, 30);
    assert_eq!(case.names()[..2], ["reconstruction.png", "frame.png"]);
    case.truth = None;
    assert_eq!(case.names()[..2], ["reconstruction.png", "frame.png"]);
}

#[test]
fn odd_shapes_are_drawn() {
    for (shape, rows, columns) in [
        (Shape::new(1, 1, 1), 1, 1),
        (Shape::new(2, 1, 1), 1, 1),
        (Shape::new(5, 40, 1), 40, 1),
        (Shape::new(5, 1, 40), 1, 40),
        (Shape::new(7, 50, 60), 24, 30),
        (Shape::new(3, 700, 20), 700, 20),
        (Shape::new(2, 10, 2000), 10, 2000),
    ] {
        let mut case = Case::new(shape, rows, columns);
        case.draws_change = true;
        assert!(case.names().len() >= 6, "{shape}");
        case.truth = None;
        let names = case.names();
        assert!(names.len() >= 6, "{shape}");
        assert_eq!(names.iter().any(|n| n == "change.png"), shape.bins > 1);
    }
}

#[test]
fn what_the_frame_tells_of_a_change_stands_below_it() {
    let mut case = Case::new(Shape::new(4, 8, 8), 8, 8);
    case.draws_change = true;
    for (informative, is_believed) in [(7.6, false), (60.0, true)] {
        let input = ReportInput {
            change_count: Some(ChangeCount {
                informative,
                of: 216,
            }),
            ..case.input()
        };
        let report = render(&input).unwrap();
        let picture = report.pictures.iter().find(|p| p.name == "change.png");
        let caption = &picture.unwrap().caption;
        let count = format!("{informative:.0} of 216 numbers");
        assert!(caption.contains(&count), "{caption}");
        assert_eq!(caption.contains("too few"), !is_believed, "{caption}");
    }
}

#[test]
fn dark_video_and_short_convergence_leave_figures_out() {
    let mut case = Case::new(Shape::new(4, 8, 8), 8, 8);
    case.video.data_mut().fill(0.0);
    case.traces.clear();
    case.truth = None;
    case.convergence.truncate(1);
    assert_eq!(
        case.names(),
        [
            "time-colour.png",
            "frames.png",
            "frame.png",
            "psf.png",
            "direct.png",
            "residual.png"
        ]
    );
}

#[test]
fn values_that_are_not_finite_do_no_harm() {
    let mut case = Case::new(Shape::new(9, 8, 8), 8, 8);
    case.residual.data_mut()[3] = f32::NAN;
    case.frame.data_mut()[5] = f32::INFINITY;
    case.video.data_mut()[9] = f32::NAN;
    case.video.data_mut()[10] = f32::INFINITY;
    case.convergence[2].change = f64::NAN;
    case.draws_change = true;
    case.convergence[4].objective = f64::INFINITY;
    case.names();
    case.residual.data_mut().fill(f32::NAN);
    case.video.data_mut().fill(f32::MAX);
    case.frame.data_mut().fill(f32::MIN);
    case.psf.data_mut().fill(f32::NEG_INFINITY);
    for iteration in &mut case.convergence {
        iteration.seconds = f64::NAN;
        iteration.residual_over_sigma = f64::NAN;
    }
    case.names();
}

#[test]
fn texts_are_escaped() {
    let case = Case::new(Shape::new(3, 8, 8), 8, 8);
    let evil = "<script>alert(\"1\")</script>&";
    let pair = (evil.to_string(), evil.to_string());
    let report = render(&ReportInput {
        title: evil,
        headline: vec![pair.clone()],
        fit: Some(FitVerdict {
            verdict: evil,
            reason: evil,
        }),
        settings: vec![(evil.into(), vec![pair.clone()])],
        files: vec![pair],
        reproduce: Some(evil),
        mp4: Some(&[0, 1, 2]),
        ..case.input()
    })
    .expect("a report");
    assert!(!report.html.contains("<script"));
    assert_eq!(report.html.matches("&lt;script&gt;").count(), 12);
    assert!(report.html.contains("src=\"data:video/mp4;base64,AAEC\""));
}

#[test]
fn the_fit_is_a_warning_unless_it_is_good() {
    let case = Case::new(Shape::new(3, 8, 8), 8, 8);
    let page = |verdict| {
        let fit = FitVerdict {
            verdict,
            reason: "the PSF is another's",
        };
        let input = ReportInput {
            fit: Some(fit),
            ..case.input()
        };
        render(&input).expect("a report").html
    };
    let sentence = "</strong>The PSF is another's.";
    assert!(page("good").contains("<p class=\"fit\""));
    assert!(page("bad").contains("<p class=\"fit warning\""));
    assert!(page("good").contains(sentence) && page("bad").contains("Fit: bad. "));
    assert!(
        !render(&case.input())
            .expect("a report")
            .html
            .contains("Fit: ")
    );
}

#[test]
fn sizes_that_contradict_each_other_are_errors() {
    let case = Case::new(Shape::new(3, 8, 8), 8, 8);
    let other = Case::new(Shape::new(4, 8, 9), 8, 9);
    let wrong = [
        ReportInput {
            truth: Some(&other.video),
            ..case.input()
        },
        ReportInput {
            residual: &other.frame,
            ..case.input()
        },
        ReportInput {
            excluded: Some(&[0]),
            ..case.input()
        },
        ReportInput {
            coverage: Some(&[1]),
            ..case.input()
        },
        ReportInput {
            instants: &[0],
            ..case.input()
        },
        ReportInput {
            traces: &other.traces,
            ..case.input()
        },
        ReportInput {
            time: &other.time,
            ..case.input()
        },
    ];
    for input in wrong {
        assert!(render(&input).unwrap_err().is_input());
    }
}

#[test]
fn the_player_alone_may_run() {
    let case = Case::new(Shape::new(3, 4, 5), 4, 5);
    let data = r#"{"a":"</script><b>"}"#;
    let report = render(&ReportInput {
        mp4: Some(&[0, 1, 2]),
        player: Some(Player {
            script: "play()",
            style: "#rowburst{color:red}",
            data,
        }),
        ..case.input()
    });
    let html = report.unwrap().html;
    // printf 'play()' | openssl dgst -sha256 -binary | base64
    let hash = "n+zc/Y1kPX/nlNEMch5ToMvMOvkxRuO4TZGxerHss+U=";
    assert!(html.contains(&format!("script-src 'sha256-{hash}'\"")));
    assert!(html.contains("<script>play()</script>"));
    assert!(html.contains("<div id=\"rowburst\"></div><noscript><figure class=\"movie\">"));
    assert!(html.contains("#rowburst{color:red}"));
    let json = r#"{"a":"\u003c/script>\u003cb>"}"#;
    assert!(html.contains(json) && !html.contains(data));
    let without = render(&case.input()).unwrap().html;
    assert!(!without.contains("script"));
}

#[test]
fn figures_for_papers_have_vector_text_and_letters() {
    let case = Case::new(Shape::new(6, 8, 9), 8, 9);
    for layout in [Layout::Fig2, Layout::Fig3] {
        let composed = compose(&case.input(), &layout.into()).unwrap();
        assert!(composed.png.starts_with(b"\x89PNG"));
        let pdf = composed.pdf();
        assert_eq!(pdf.is_ok(), cfg!(feature = "pdf"));
        assert!(pdf.is_err() || pdf.is_ok_and(|pdf| pdf.starts_with(b"%PDF")));
        let options = resvg::usvg::Options::default();
        resvg::usvg::Tree::from_str(&composed.svg, &options).unwrap();
        for text in [">a</text>", ">b</text>", ">c</text>"] {
            assert!(composed.svg.contains(text), "{layout:?} {text}");
        }
    }
}

#[test]
fn figures_for_papers_have_chosen_panels_bins_and_width() {
    let case = Case::new(Shape::new(6, 8, 9), 8, 9);
    let options = FigureOptions {
        width_mm: Some(86.0),
        panels: vec!["traces".into(), "frames".into()],
        bins: vec![1, 4],
        ..Layout::Fig2.into()
    };
    let composed = compose(&case.input(), &options).unwrap();
    assert!(composed.svg.contains("width=\"86mm\""));
    // Two panels, and two bins with their rows.
    assert!(composed.svg.contains(">b</text>") && !composed.svg.contains(">c</text>"));
    assert_eq!(composed.svg.matches(">difference<").count(), 1);
    let png = image_size(&composed.png);
    assert!(
        (f64::from(png.0) - 86.0 / 25.4 * 600.0).abs() < 2.0,
        "{png:?}"
    );
    let wrong = FigureOptions {
        bins: vec![6],
        ..Layout::Fig2.into()
    };
    assert!(compose(&case.input(), &wrong).unwrap_err().is_input());
}

/// Width and height in the head of a PNG.
fn image_size(png: &[u8]) -> (u32, u32) {
    let number = |at: usize| u32::from_be_bytes(png[at..at + 4].try_into().unwrap());
    (number(16), number(20))
}
