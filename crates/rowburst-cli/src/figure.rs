//! `rowburst figure`: a figure for a paper from a result folder.

use crate::args::{FigureArgs, FigureLayout};
use crate::output::print_line;
use rowburst::{Error, Parameter, Result};
use rowburst_io::OutputFolder;
use rowburst_report::{FigureOptions, Layout};
use rowburst_run::figure_of_folder;
use std::path::{Path, PathBuf};

pub fn run(args: &FigureArgs) -> Result<()> {
    let format = FigureFormat::of(&args.output)?;
    let layout = match args.layout {
        FigureLayout::Fig2 => Layout::Fig2,
        FigureLayout::Fig3 => Layout::Fig3,
    };
    let options = FigureOptions {
        layout,
        width_mm: args.width_mm,
        panels: args.panels.clone(),
        bins: args.bins.clone(),
    };
    let figure = figure_of_folder(&args.result, &options)?;
    let bytes = match format {
        FigureFormat::Svg => figure.svg.into_bytes(),
        FigureFormat::Png => figure.png,
        FigureFormat::Pdf => figure.pdf()?,
    };
    write(&args.output, &bytes)?;
    print_line(args.output.display());
    Ok(())
}

enum FigureFormat {
    Svg,
    Png,
    Pdf,
}

impl FigureFormat {
    /// The format that the ending of the file asks for.
    fn of(path: &Path) -> Result<Self> {
        let kind = path.extension().and_then(|e| e.to_str());
        match kind.map(str::to_ascii_lowercase).as_deref() {
            Some("svg") => Ok(Self::Svg),
            Some("png") => Ok(Self::Png),
            Some("pdf") => Ok(Self::Pdf),
            _ => Err(Error::input(
                Parameter::Output,
                path.display(),
                "a figure is an .svg, .pdf or .png file",
                "Give the file one of these endings.",
            )),
        }
    }
}

fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty());
    let folder = OutputFolder::create(folder.unwrap_or(&PathBuf::from(".")))?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    folder.write_bytes(&name, bytes)
}
