//! `qudi view`: its page in a browser, and everything that it refuses.

use crate::browser::Browser;
use crate::support::{refused, run, scratch};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// A running `qudi view`, stopped when it is dropped.
struct View {
    process: Child,
    url: String,
}

impl View {
    fn start(folder: &Path, args: &str) -> Self {
        Self::start_with(folder, &args.split_whitespace().collect::<Vec<_>>())
    }

    fn start_with(folder: &Path, args: &[&str]) -> Self {
        let mut process = Command::new(env!("CARGO_BIN_EXE_qudi"))
            .current_dir(folder)
            .arg("view")
            .args(args)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut url = String::new();
        BufReader::new(process.stdout.take().unwrap()).read_line(&mut url).unwrap();
        Self { process, url: url.trim().to_owned() }
    }

    /// Returns the host with its port, and the path with its token.
    fn parts(&self) -> (&str, &str) {
        let rest = self.url.strip_prefix("http://").unwrap();
        rest.split_at(rest.find('/').unwrap())
    }

    /// Sends bytes and returns the answer.
    fn ask(&self, request: &[u8]) -> String {
        let mut stream = TcpStream::connect(self.parts().0).unwrap();
        stream.set_read_timeout(Some(Duration::from_mins(1))).unwrap();
        stream.write_all(request).unwrap();
        let mut answer = Vec::new();
        // A refused request may still be on its way when the server hangs up.
        let _ = stream.read_to_end(&mut answer);
        String::from_utf8_lossy(&answer).into_owned()
    }

    /// Asks for a path below the token, with further headers.
    fn get(&self, path: &str, headers: &str) -> String {
        let (host, token) = self.parts();
        self.ask(format!("GET {token}{path} HTTP/1.1\r\nHost: {host}\r\n{headers}\r\n").as_bytes())
    }
}

impl Drop for View {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

fn capture(name: &str) -> PathBuf {
    let folder = scratch(name);
    run(&folder, "simulate scene:text --size 32x40 --frames 25 --ppp 9.75 --seed 1 -o b.npy -q");
    folder
}

#[test]
fn serves_its_page_and_frames() {
    let folder = capture("view-serves");
    let view = View::start(&folder, "b.npy --device cpu");
    assert!(view.url.starts_with("http://127.0.0.1:"), "{}", view.url);
    assert_eq!(view.parts().1.len(), 34, "a token of 32 digits: {}", view.url);
    let page = view.get("", "");
    assert!(page.starts_with("HTTP/1.1 200 OK") && page.contains("<h1>b.npy</h1>"), "{page}");
    assert!(page.contains("\"path\":\"frame/qbp-refined\"") && !page.contains("data:image"));
    for header in
        ["Cache-Control: no-store", "X-Content-Type-Options: nosniff", "frame-ancestors 'none'"]
    {
        assert!(page.contains(header), "{header}");
    }
    for layer in ["counts", "mle", "qbp-refined", "mle"] {
        let frame = view.get(&format!("frame/{layer}/24"), "Sec-Fetch-Site: same-origin\r\n");
        assert!(frame.starts_with("HTTP/1.1 200 OK") && frame.contains("image/jpeg"), "{frame}");
    }
    for path in [
        "frame/mle/25",
        "frame/emvd/1",
        "frame/mle",
        "frame/mle/1/2",
        "favicon.ico",
        "../b.npy",
        "%2e%2e/b.npy",
    ] {
        let answer = view.get(path, "");
        assert!(answer.starts_with("HTTP/1.1 404"), "{path}: {answer}");
        assert!(answer.ends_with("nothing here"), "{path}: {answer}");
    }
}

#[test]
fn serves_the_colours_of_a_mosaic() {
    let folder = scratch("view-mosaic");
    run(
        &folder,
        "simulate scene:chart --cfa rggb --size 32x40 --frames 11 --ppp 9.75 --seed 1 -o m.npy -q",
    );
    let view = View::start(&folder, "m.npy --device cpu");
    assert!(view.get("", "").contains("colours"));
    for layer in ["counts", "mle", "qbp-refined"] {
        let frame = view.get(&format!("frame/{layer}/5"), "Sec-Fetch-Site: same-origin\r\n");
        assert!(frame.starts_with("HTTP/1.1 200 OK") && frame.contains("image/jpeg"), "{frame}");
    }
}

#[test]
fn refuses_foreign_requests() {
    let folder = capture("view-refuses");
    let view = View::start(&folder, "b.npy --device cpu");
    let (host, token) = view.parts();
    let port = host.split_once(':').unwrap().1;
    let status = |request: String| {
        let answer = view.ask(request.as_bytes());
        answer.split(' ').nth(1).unwrap_or_default().to_owned()
    };
    for method in ["POST", "PUT", "DELETE", "HEAD", "OPTIONS"] {
        let request =
            format!("{method} {token} HTTP/1.1\r\nHost: {host}\r\nContent-Length: 0\r\n\r\n");
        assert_eq!(status(request), "405", "{method}");
    }
    for line in [
        "Host: evil.example".to_owned(),
        format!("Host: evil.example:{port}"),
        "Host: 127.0.0.1:1".to_owned(),
        format!("Host: {host}\r\nOrigin: http://evil.example"),
        format!("Host: {host}\r\nOrigin: null"),
        format!("Host: {host}\r\nSec-Fetch-Site: cross-site"),
    ] {
        assert_eq!(status(format!("GET {token} HTTP/1.1\r\n{line}\r\n\r\n")), "403", "{line}");
    }
    for path in ["/", "/0123456789abcdef0123456789abcdef/", "/frame/mle/1", "/b.npy"] {
        assert_eq!(status(format!("GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n")), "404", "{path}");
    }
    assert_eq!(status("\r\n\r\n".to_owned()), "400");
    assert_eq!(status(format!("GET {token} HTTP/1.1\r\n\r\n")), "400", "no host");
    let long = format!("GET {token} HTTP/1.1\r\nHost: {host}\r\nX: {}\r\n\r\n", "x".repeat(20_000));
    assert!(["431", ""].contains(&status(long).as_str()));
    // Other addresses of this computer lead nowhere.
    if cfg!(target_os = "linux") {
        assert!(TcpStream::connect(format!("127.0.0.2:{port}")).is_err());
    }
    // Connections that say nothing do not stop it from answering.
    let silent: Vec<_> = (0..10).map(|_| TcpStream::connect(host).unwrap()).collect();
    assert!(view.get("", "").starts_with("HTTP/1.1 200"));
    drop(silent);
    assert!(view.get("frame/mle/1", "").starts_with("HTTP/1.1 200"));
}

#[test]
fn plays_in_a_browser() {
    let folder = capture("view-browser");
    let view = View::start(&folder, "b.npy --device cpu");
    let Some(mut browser) = Browser::start(&folder) else { return };
    browser.open(&view.url, 1000);
    let drawn = "document.querySelector('.player').player.incomplete === false";
    browser.wait_for(drawn);
    browser.evaluate("document.querySelector('.stage canvas').focus()");
    browser.press("ArrowRight", None);
    browser.wait_for(&format!("document.querySelector('.time').value === '13' && {drawn}"));
    browser.evaluate(
        "{ const s = document.querySelector('[data-side=right]'); \
         s.value = [...s.options].findIndex(o => o.text === 'mle'); s.dispatchEvent(new Event('change')); }",
    );
    browser.wait_for(&format!(
        "document.querySelector('.tag.right').textContent === 'mle' && {drawn}"
    ));
    // The browser asks for an icon, which there is not.
    let errors: Vec<_> =
        browser.said.iter().filter(|said| !said.to_string().contains("favicon")).collect();
    assert!(errors.is_empty(), "{errors:?}");
}

/// A capture and the sensor of its record have names like markup: they are shown, and do not run.
#[test]
fn names_with_markup_are_text() {
    const MARKUP: &str = "<img src=x onerror=document.title='run'>";
    let folder = capture("view-markup");
    let name = format!("{MARKUP}.npy");
    std::fs::rename(folder.join("b.npy"), folder.join(&name)).unwrap();
    let record = std::fs::read_to_string(folder.join("b.npy.json")).unwrap();
    let mut record: serde_json::Value = serde_json::from_str(&record).unwrap();
    record["simulation"]["sensor"]["name"] = MARKUP.into();
    std::fs::write(folder.join(format!("{name}.json")), record.to_string()).unwrap();
    let view = View::start_with(&folder, &[name.as_str(), "--device", "cpu"]);
    let page = view.get("", "");
    assert!(page.contains("&lt;img src=x") && !page.contains("<img src=x"), "{page}");
    assert!(page.matches("&lt;img src=x").count() > 1, "the sensor's name, too");
    let Some(mut browser) = Browser::start(&folder) else { return };
    browser.open(&view.url, 1000);
    browser.wait_for("document.querySelector('.player').player.incomplete === false");
    assert_ne!(browser.evaluate("document.title"), "run");
    assert_eq!(browser.evaluate("document.images.length"), 0);
}

#[test]
fn refuses_pipes_and_taken_ports() {
    let folder = capture("view-ports");
    refused(&folder, "view -", &["a pipe comes once"]);
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    refused(
        &folder,
        &format!("view b.npy --device cpu --port {port}"),
        &["cannot listen", "--port"],
    );
    refused(&folder, "view missing.npy", &["missing.npy"]);
}
