//! Opens a page of this machine in the browser.

use crate::output::print_line;
use crate::shared_args::BrowserArgs;
use rowburst_view::Server;
use std::io::{self, Write};
use std::time::Duration;
use tempfile::TempPath;

/// Time after which the file that leads the browser to the page is removed; browsers read it within seconds.
const REDIRECT_LIFE: Duration = Duration::from_secs(60);

/// Prints the address of the page and opens it.
pub fn open_page(server: &Server, args: &BrowserArgs) {
    print_line(server.url());
    open(server, args);
}

/// Opens the page where that is wanted and there is a screen.
///
/// The address holds the token, and other users see the arguments of a browser. So it gets a file that only this user
/// reads, which leads to the address.
pub fn open(server: &Server, args: &BrowserArgs) {
    let url = server.url();
    let has_screen = !cfg!(target_os = "linux")
        || ["DISPLAY", "WAYLAND_DISPLAY"]
            .iter()
            .any(|name| std::env::var_os(name).is_some_and(|v| !v.is_empty()));
    if args.no_open || !has_screen {
        return;
    }
    let opened = redirect_file(&url).and_then(|file| {
        open::that_detached(file.as_os_str())?;
        Ok(file)
    });
    match opened {
        Ok(file) => {
            std::thread::spawn(move || {
                std::thread::sleep(REDIRECT_LIFE);
                drop(file);
            });
        }
        Err(_) => eprintln!("no browser could be started: open {url} yourself"),
    }
}

/// A file for this user alone that leads a browser to `url`; removed when dropped.
fn redirect_file(url: &str) -> io::Result<TempPath> {
    // Files of `tempfile` have the mode 0600.
    let mut file = tempfile::Builder::new()
        .prefix("rowburst-")
        .suffix(".html")
        .tempfile()?;
    write!(
        file,
        "<!DOCTYPE html>\n<meta charset=\"utf-8\">\n<title>Rowburst</title>\n<meta http-equiv=\"refresh\" content=\"0; url={url}\">\n<a href=\"{url}\">Rowburst</a>\n"
    )?;
    Ok(file.into_temp_path())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The address with the token is no argument of a program; it is in a file that others cannot read.
    #[cfg(unix)]
    #[test]
    fn the_token_is_for_this_user_alone() {
        use std::os::unix::fs::PermissionsExt;
        let url = "http://127.0.0.1:1234/?token=abc";
        let file = redirect_file(url).unwrap();
        let mode = std::fs::metadata(&file).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        assert!(std::fs::read_to_string(&file).unwrap().contains(url));
        assert!(!file.to_string_lossy().contains("abc"));
        let path = file.to_path_buf();
        drop(file);
        assert!(!path.exists());
    }
}
