//! The HTML page.

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use sha2::{Digest, Sha256};

use maud::{DOCTYPE, Markup, PreEscaped, html};

use crate::figures::{Section, time_text};
use crate::format::{TimeUnit, grouped, number};
use crate::{FitVerdict, Player, ReportInput};

const STYLE: &str = include_str!("style.css");

/// No request leaves the page, whatever is in it. The player's script alone may run.
fn policy(player: Option<Player>) -> String {
    let mut policy =
        "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'".to_string();
    if let Some(player) = player {
        let hash = BASE64_STANDARD.encode(Sha256::digest(player.script));
        policy += &format!("; script-src 'sha256-{hash}'");
    }
    policy
}

/// A figure of the page.
pub(crate) struct Entry {
    pub svg: String,
    /// Whether it takes the full width.
    pub wide: bool,
    pub file: String,
    pub caption: String,
}

/// A page: words, figures and tables.
pub(crate) struct Page<'a> {
    pub title: &'a str,
    pub summary: String,
    /// The verdict that stands above everything else.
    pub verdict: Option<FitVerdict<'a>>,
    /// What the reader must know before the numbers.
    pub warnings: &'a [String],
    /// What the numbers rest on.
    pub notes: &'a [String],
    pub headline: &'a [(String, String)],
    pub fit: Option<FitVerdict<'a>>,
    pub player: Option<Player<'a>>,
    pub parts: Vec<Part<'a>>,
    pub settings: &'a [(String, Vec<(String, String)>)],
    pub files: &'a [(String, String)],
    pub reproduce: Option<&'a str>,
}

/// A heading with what stands under it.
pub(crate) struct Part<'a> {
    pub heading: &'a str,
    /// Whether the player stands here.
    pub plays: bool,
    pub mp4: Option<&'a [u8]>,
    pub entries: Vec<Entry>,
}

/// The page of a reconstruction.
pub(crate) fn page(input: &ReportInput, entries: Vec<(Section, Entry)>) -> String {
    let mut parts = [
        (Section::Video, "Reconstruction"),
        (Section::Measurement, "Measurement"),
        (Section::Fit, "Fit"),
    ]
    .map(|(section, heading)| {
        let part = Part {
            heading,
            plays: section == Section::Video,
            mp4: input.mp4.filter(|_| section == Section::Video),
            entries: Vec::new(),
        };
        (section, part)
    });
    for (section, entry) in entries {
        let part = parts.iter_mut().find(|(of, _)| *of == section);
        part.expect("every section has its part")
            .1
            .entries
            .push(entry);
    }
    Page {
        title: input.title,
        summary: summary(input),
        verdict: None,
        warnings: &[],
        notes: &[],
        headline: &input.headline,
        fit: input.fit,
        player: input.player,
        parts: parts.into_iter().map(|(_, part)| part).collect(),
        settings: &input.settings,
        files: &input.files,
        reproduce: input.reproduce,
    }
    .html()
}

impl Page<'_> {
    /// The HTML. All texts are escaped; the SVGs are ours.
    pub(crate) fn html(&self) -> String {
        html! {
            (DOCTYPE)
            html lang="en-GB" {
                head {
                    meta charset="utf-8";
                    meta http-equiv="Content-Security-Policy" content=(policy(self.player));
                    meta name="viewport" content="width=device-width, initial-scale=1";
                    meta name="color-scheme" content="light dark";
                    meta name="generator" content={ "Rowburst " (env!("CARGO_PKG_VERSION")) };
                    title { (self.title) }
                    style { (PreEscaped(STYLE)) }
                    @if let Some(player) = self.player { style { (PreEscaped(player.style)) } }
                }
                body {
                    header {
                        h1 { (self.title) }
                        p.summary { (self.summary) }
                        @if let Some(verdict) = self.verdict { (verdict_of("Verdict", verdict)) }
                        @for warning in self.warnings {
                            p.warning role="note" { strong { "Warning: " } (warning) }
                        }
                        (headline(self.headline))
                        @for note in self.notes { p.summary { (note) } }
                        @if let Some(fit) = self.fit { (verdict_of("Fit", fit)) }
                    }
                    main {
                        @for part in &self.parts {
                            section {
                                h2 { (part.heading) }
                                @if part.plays && self.player.is_some() {
                                    div id="rowburst" {}
                                    noscript { @if let Some(mp4) = part.mp4 { (movie(mp4)) } }
                                } @else if let Some(mp4) = part.mp4 { (movie(mp4)) }
                                div.figures { @for entry in &part.entries { (figure(entry)) } }
                            }
                        }
                        (settings(self.settings))
                        (files(self.files, self.reproduce))
                    }
                    footer { p { "Rowburst " (env!("CARGO_PKG_VERSION")) ", rolling-shutter compressive imaging." } }
                    @if let Some(player) = self.player {
                        // Within a script element nothing but "</" ends it: JSON has other words for "<".
                        script type="application/json" id="rowburst-data" {
                            (PreEscaped(player.data.replace('<', "\\u003c")))
                        }
                        script { (PreEscaped(player.script)) }
                    }
                }
            }
        }
        .into_string()
    }
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
         per second, one every {} µs. {}",
        shape.bins,
        shape.rows,
        shape.columns,
        number(shape.bins as f64 * step_us / unit.us, 4),
        unit.name,
        grouped(input.time.frame_rate_hz()),
        number(step_us, 4),
        time_text(input),
    )
}

fn headline(headline: &[(String, String)]) -> Markup {
    html! {
        @if !headline.is_empty() {
            dl.headline {
                @for (name, value) in headline {
                    div { dt { (name) } dd { (value) } }
                }
            }
        }
    }
}

/// A verdict under its name; all but "good" is a warning.
fn verdict_of(name: &str, fit: FitVerdict) -> Markup {
    html! {
        p.fit.warning[fit.verdict != "good"] role="note" {
            strong { (name) ": " (fit.verdict) ". " } (capital(fit.reason)) "."
        }
    }
}

/// `sentence` with its first letter as a capital; one of more bytes, such as σ, stays.
fn capital(sentence: &str) -> String {
    let mut text = sentence.to_string();
    if let Some(first) = text.get_mut(..1) {
        first.make_ascii_uppercase();
    }
    text
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

fn settings(settings: &[(String, Vec<(String, String)>)]) -> Markup {
    html! {
        @if !settings.is_empty() {
            section {
                h2 { "Numbers and settings" }
                p { "All that is needed to repeat the run." }
                div.tables {
                    @for (name, rows) in settings {
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

fn files(files: &[(String, String)], reproduce: Option<&str>) -> Markup {
    html! {
        @if reproduce.is_some() || !files.is_empty() {
            section {
                h2 { "Files and command" }
                @if !files.is_empty() {
                    dl.files {
                        @for (name, what) in files {
                            dt { code { (name) } } dd { (what) }
                        }
                    }
                }
                @if let Some(command) = reproduce {
                    p { "To repeat the run:" }
                    pre { code { (command) } }
                }
            }
        }
    }
}
