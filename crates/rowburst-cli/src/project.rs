//! `rowburst new` and `rowburst status`: the folder of an experiment.

use crate::output::print_line;
use clap::Args;
use rowburst::Result;
use rowburst_capture::{Project, create_project};
use serde_json::json;
use std::path::PathBuf;

/// Make a folder that leads through calibration, acquisition and reconstruction.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rowburst new bench --source play:recording.tif\n  cd bench\n  rowburst status"
)]
pub struct NewArgs {
    /// The folder
    pub name: PathBuf,
    /// Where frames come from; see rowburst capture. It can be written into rowburst.toml later
    #[arg(long, default_value = "")]
    pub source: String,
}

/// Say what the folder of an experiment holds, what is missing or out of date, and the next command.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  rowburst status\n  rowburst status bench --json")]
pub struct StatusArgs {
    /// The folder that rowburst new has made
    #[arg(default_value = ".")]
    pub folder: PathBuf,
    /// Print the steps as JSON
    #[arg(long)]
    pub json: bool,
}

pub fn create(args: &NewArgs) -> Result<()> {
    create_project(&args.name, &args.source)?;
    print_line(args.name.display());
    eprintln!("next: cd {}; rowburst status", args.name.display());
    Ok(())
}

pub fn status(args: &StatusArgs) -> Result<()> {
    let steps = Project::open(&args.folder)?.status()?;
    let next = steps.iter().find(|step| step.state.is_open());
    let next = next.map(|step| step.command.as_str());
    if args.json {
        let list = steps.iter().map(|step| {
            json!({
                "name": step.name, "state": step.state.name(),
                "detail": step.detail, "command": step.command,
            })
        });
        let list: Vec<_> = list.collect();
        print_line(format_args!("{:#}", json!({ "steps": list, "next": next })));
        return Ok(());
    }
    for step in &steps {
        print_line(format_args!(
            "{:<17} {:<12} {}",
            step.name,
            step.state.name(),
            step.detail
        ));
    }
    match next {
        Some(command) => print_line(format_args!("next: {command}")),
        None => print_line("everything is there"),
    }
    Ok(())
}
