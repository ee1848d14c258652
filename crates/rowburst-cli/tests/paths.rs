//! A folder whose name has a space, umlauts and a micro sign, on every system.

mod common;

use common::{Lab, program};
use std::process::Command;

const FOLDER: &str = "Größe µ x";

/// A laboratory with the folder in it.
fn lab() -> Lab {
    let lab = Lab::empty();
    std::fs::create_dir(lab.path(FOLDER)).unwrap();
    lab
}

/// The program with `arguments`; `@` stands for the folder.
fn command(lab: &Lab, arguments: &str) -> Command {
    let mut command = Command::new(program());
    let words = arguments.split(' ').map(|word| word.replace('@', FOLDER));
    command.args(words).current_dir(lab.path(""));
    command
}

/// Runs the program, which must succeed; its standard output.
fn done(lab: &Lab, arguments: &str) -> String {
    let output = command(lab, arguments).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments}: {said}");
    String::from_utf8(output.stdout).unwrap()
}

const RECONSTRUCT: &str = "reconstruct @/demo/experiment.toml --frame @/demo/frame.npy --prior tv+support --max-iterations 10 -o @/Lösung";

#[test]
fn demo_reconstruct_and_figure_work_in_it() {
    let lab = lab();
    done(&lab, "demo -o @/demo");
    for name in ["report.html", "video.npy", "result.json"] {
        assert!(
            lab.path(&format!("{FOLDER}/demo/{name}")).is_file(),
            "{name}"
        );
    }
    let printed = done(&lab, RECONSTRUCT);
    assert!(printed.contains("Lösung"), "{printed}");
    let first = lab.read(&format!("{FOLDER}/Lösung/video.npy"));
    // Each file is renamed over the one that is there.
    done(&lab, RECONSTRUCT);
    assert_eq!(lab.read(&format!("{FOLDER}/Lösung/video.npy")), first);
    done(&lab, "figure @/Lösung --layout fig2 -o @/Bild_ä.png");
    assert!(
        lab.read(&format!("{FOLDER}/Bild_ä.png"))
            .starts_with(b"\x89PNG")
    );
    #[cfg(feature = "view")]
    view(&lab);
}

/// The viewer serves the result: its list of files, and the video.
#[cfg(feature = "view")]
fn view(lab: &Lab) {
    use std::io::{BufRead, BufReader, Read, Write};
    use std::process::Stdio;
    let mut server = command(lab, "view @/Lösung --port 0 --no-open")
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(server.stdout.take().unwrap())
        .read_line(&mut line)
        .unwrap();
    let (address, token) = line.trim()["http://".len()..]
        .split_once("/?token=")
        .unwrap();
    let port = address.rsplit(':').next().unwrap();
    let get = |path: &str| {
        let mut stream = std::net::TcpStream::connect(address).unwrap();
        let cookie = format!("Cookie: rowburst-{port}={token}");
        write!(
            stream,
            "GET {path} HTTP/1.1\r\nHost: localhost\r\n{cookie}\r\nConnection: close\r\n\r\n"
        )
        .unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        answer
    };
    let listed = String::from_utf8_lossy(&get("/api/view")).into_owned();
    let video = get("/api/result/0/file/video.npy");
    server.kill().unwrap();
    server.wait().unwrap();
    assert!(
        listed.starts_with("HTTP/1.1 200") && listed.contains("Lösung"),
        "{listed}"
    );
    assert!(video.starts_with(b"HTTP/1.1 200"));
    assert!(
        video.ends_with(&lab.read(&format!("{FOLDER}/Lösung/video.npy"))),
        "the video as it is stored"
    );
}
