//! A headless browser for tests of pages: Chromium where it is installed, driven through a pipe by the
//! protocol of its developer tools.

use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

/// Names that Chromium goes by.
const NAMES: [&str; 4] = ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"];

/// Time for a page to do what is waited for: machines that test are busy.
const TIMEOUT: Duration = Duration::from_mins(1);

/// A browser with one page.
pub(crate) struct Browser {
    process: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
    session: Option<String>,
    sent: u64,
    /// Errors that the page wrote to the console, and exceptions of its scripts.
    pub(crate) said: Vec<Value>,
}

impl Browser {
    /// Starts the browser with a profile in `folder`; none where it is not installed.
    #[allow(clippy::print_stderr)] // a test that is skipped says so
    pub(crate) fn start(folder: &Path) -> Option<Self> {
        let found = |name: &&str| {
            let version = Command::new(name).arg("--version").stderr(Stdio::null()).output();
            cfg!(unix) && version.is_ok_and(|version| version.status.success())
        };
        let Some(name) = NAMES.into_iter().find(found) else {
            eprintln!("skipped: no Chromium ({}) on the PATH", NAMES.join(", "));
            return None;
        };
        // The protocol's pipe is the descriptors 3 and 4.
        let script = "exec \"$0\" --headless --no-sandbox --disable-gpu --user-data-dir=\"$1\" --remote-debugging-pipe about:blank 3<&0 4>&1";
        let mut process = Command::new("sh")
            .args(["-c", script, name])
            .arg(folder.join("profile"))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let (input, output) = (process.stdin.take().unwrap(), process.stdout.take().unwrap());
        let output = BufReader::new(output);
        let mut browser = Self { process, input, output, session: None, sent: 0, said: Vec::new() };
        let target = browser.call("Target.createTarget", json!({"url": "about:blank"}));
        let attach = json!({"targetId": target["targetId"], "flatten": true});
        let session = browser.call("Target.attachToTarget", attach)["sessionId"].clone();
        browser.session = session.as_str().map(str::to_owned);
        for domain in ["Page", "Runtime", "Log"] {
            browser.call(&format!("{domain}.enable"), json!({}));
        }
        Some(browser)
    }

    /// Calls a method of the protocol and returns its result.
    pub(crate) fn call(&mut self, method: &str, params: Value) -> Value {
        self.sent += 1;
        let mut message = json!({"id": self.sent, "method": method, "params": params});
        if let Some(session) = &self.session {
            message["sessionId"] = json!(session);
        }
        self.input.write_all(message.to_string().as_bytes()).unwrap();
        self.input.write_all(b"\0").unwrap();
        self.input.flush().unwrap();
        loop {
            let mut bytes = Vec::new();
            self.output.read_until(0, &mut bytes).unwrap();
            assert_eq!(bytes.pop(), Some(0), "the browser ended during {method}");
            let message: Value = serde_json::from_slice(&bytes).unwrap();
            if message["id"] == self.sent {
                assert!(message["error"].is_null(), "{method}: {message}");
                return message["result"].clone();
            }
            let params = &message["params"];
            let is_problem = match message["method"].as_str().unwrap_or_default() {
                "Runtime.exceptionThrown" => true,
                "Runtime.consoleAPICalled" => params["type"] == "error",
                "Log.entryAdded" => params["entry"]["level"] == "error",
                _ => false,
            };
            if is_problem {
                self.said.push(params.clone());
            }
        }
    }

    /// Opens a page at a window width in CSS pixels.
    pub(crate) fn open(&mut self, url: &str, width: u32) {
        self.resize(width);
        self.call("Page.navigate", json!({"url": url}));
        self.wait_for("document.readyState === 'complete' && location.href !== 'about:blank'");
    }

    pub(crate) fn resize(&mut self, width: u32) {
        let size = json!({"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": false});
        self.call("Emulation.setDeviceMetricsOverride", size);
    }

    /// Asks for light or dark pages.
    pub(crate) fn prefer(&mut self, scheme: &str) {
        let features = json!([{"name": "prefers-color-scheme", "value": scheme}]);
        self.call("Emulation.setEmulatedMedia", json!({"features": features}));
    }

    /// Evaluates an expression in the page.
    pub(crate) fn evaluate(&mut self, expression: &str) -> Value {
        let params = json!({"expression": expression, "returnByValue": true, "awaitPromise": true});
        let result = self.call("Runtime.evaluate", params);
        assert!(result["exceptionDetails"].is_null(), "{expression}: {result}");
        result["result"]["value"].clone()
    }

    /// Waits until an expression is true in the page.
    pub(crate) fn wait_for(&mut self, expression: &str) {
        let end = Instant::now() + TIMEOUT;
        while self.evaluate(&format!("Boolean({expression})")) != true {
            assert!(
                Instant::now() < end,
                "never true: {expression}; the page said {:?}",
                self.said
            );
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Presses a key, as on a keyboard.
    pub(crate) fn press(&mut self, key: &str, text: Option<&str>) {
        for kind in ["keyDown", "keyUp"] {
            let mut event = json!({"type": kind, "key": key, "code": key});
            if let (Some(text), "keyDown") = (text, kind) {
                event["text"] = json!(text);
            }
            self.call("Input.dispatchKeyEvent", event);
        }
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
