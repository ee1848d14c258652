//! Sees to it that the folder of the page exists, so that a build without Node works: the
//! program then has no page, and says how to get it.

fn main() {
    let page = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../web/dist");
    // A folder that cannot be made is as one without a page.
    let _ = std::fs::create_dir_all(&page);
    println!("cargo:rerun-if-changed={}", page.display());
}
