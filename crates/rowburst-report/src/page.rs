//! The HTML page.

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use maud::{DOCTYPE, Markup, PreEscaped, html};

use crate::ReportInput;
use crate::figures::Section;
use crate::format::{TimeUnit, grouped, number};

const STYLE: &str = include_str!("style.css");

/// No request leaves the page, whatever is in it.
const POLICY: &str =
    "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'";

/// A figure of the page.
pub(crate) struct Entry {
    pub section: Section,
    pub svg: String,
    /// Whether it takes the full width.
    pub wide: bool,
    pub file: String,
    pub caption: String,
}

/// The page with its figures. All texts are escaped; the SVGs are ours.
pub(crate) fn page(input: &ReportInput, entries: Vec<Entry>) -> String {
    let section = |section: Section| {
        let figures = entries.iter().filter(move |e| e.section == section);
        html! { div.figures { @for entry in figures { (figure(entry)) } } }
    };
    html! {
        (DOCTYPE)
        html lang="en-GB" {
            head {
                meta charset="utf-8";
                meta http-equiv="Content-Security-Policy" content=(POLICY);
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                meta name="generator" content={ "Rowburst " (env!("CARGO_PKG_VERSION")) };
                title { (input.title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                header {
                    h1 { (input.title) }
                    p.summary { (summary(input)) }
                    (headline(input))
                }
                main {
                    section {
                        h2 { "Reconstruction" }
                        @if let Some(mp4) = input.mp4 { (movie(mp4)) }
                        (section(Section::Video))
                    }
                    section { h2 { "Measurement" } (section(Section::Measurement)) }
                    section { h2 { "Fit" } (section(Section::Fit)) }
                    (settings(input))
                    (files(input))
                }
                footer { p { "Rowburst " (env!("CARGO_PKG_VERSION")) ", rolling-shutter compressive imaging." } }
            }
        }
    }
    .into_string()
}

/// One line of what was made of what.
fn summary(input: &ReportInput) -> String {
    let shape = input.video.shape();
    let (rows, columns) = (input.frame.rows(), input.frame.columns());
    if shape.bins == 1 {
        return format!(
            "One frame of {rows} × {columns} pixels, one image of {} × {}.",
            shape.rows, shape.columns
        );
    }
    let step_us = input.time.bin_duration_us();
    let unit = TimeUnit::of(shape.bins as f64 * step_us);
    format!(
        "One frame of {rows} × {columns} pixels became {} frames of {} × {}: {} {} at {} frames \
         per second, one every {} µs.",
        shape.bins,
        shape.rows,
        shape.columns,
        number(shape.bins as f64 * step_us / unit.us, 4),
        unit.name,
        grouped(input.time.frame_rate_hz()),
        number(step_us, 4),
    )
}

fn headline(input: &ReportInput) -> Markup {
    html! {
        @if !input.headline.is_empty() {
            dl.headline {
                @for (name, value) in &input.headline {
                    div { dt { (name) } dd { (value) } }
                }
            }
        }
    }
}

fn figure(entry: &Entry) -> Markup {
    html! {
        figure.wide[entry.wide] {
            div.scroll { (PreEscaped(&entry.svg)) }
            figcaption { (entry.caption) " " span.file { (entry.file) } }
        }
    }
}

fn movie(mp4: &[u8]) -> Markup {
    html! {
        figure.movie {
            video controls loop muted playsinline
                src={ "data:video/mp4;base64," (BASE64_STANDARD.encode(mp4)) } {}
            figcaption { "The reconstructed video, slowed down." }
        }
    }
}

fn settings(input: &ReportInput) -> Markup {
    html! {
        @if !input.settings.is_empty() {
            section {
                h2 { "Numbers and settings" }
                p { "All that is needed to repeat the run." }
                div.tables {
                    @for (name, rows) in &input.settings {
                        table {
                            caption { (name) }
                            tbody {
                                @for (name, value) in rows {
                                    tr { th scope="row" { (name) } td { (value) } }
                                }
                            }
                        }
                    }
                }
            }
        }
    }
}

fn files(input: &ReportInput) -> Markup {
    html! {
        @if input.reproduce.is_some() || !input.files.is_empty() {
            section {
                h2 { "Files and command" }
                @if !input.files.is_empty() {
                    dl.files {
                        @for (name, what) in &input.files {
                            dt { code { (name) } } dd { (what) }
                        }
                    }
                }
                @if let Some(command) = input.reproduce {
                    p { "To repeat the run:" }
                    pre { code { (command) } }
                }
            }
        }
    }
}
