//! Opens a page of this machine in the browser.

use crate::output::print_line;
use crate::shared_args::BrowserArgs;
use rowburst_view::Server;

/// Prints the address of the page and opens it.
pub fn open_page(server: &Server, args: &BrowserArgs) {
    print_line(server.url());
    open(server, args);
}

/// Opens the page where that is wanted and there is a screen.
pub fn open(server: &Server, args: &BrowserArgs) {
    let url = server.url();
    let has_screen = !cfg!(target_os = "linux")
        || ["DISPLAY", "WAYLAND_DISPLAY"]
            .iter()
            .any(|name| std::env::var_os(name).is_some_and(|v| !v.is_empty()));
    if !args.no_open && has_screen && open::that_detached(&url).is_err() {
        eprintln!("no browser could be started: open {url} yourself");
    }
}
