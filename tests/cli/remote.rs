//! `qudi serve` and remote devices, all on this machine.

use crate::support::{qudi, refused, scratch};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};

/// A server that ends with the test.
struct Server {
    process: Child,
    /// Held open while the server runs, which ends when nobody can read its output.
    _output: BufReader<ChildStdout>,
    /// `ws://127.0.0.1:PORT`
    name: String,
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

fn serve(devices: &str, token: &str) -> Server {
    let mut process = Command::new(env!("CARGO_BIN_EXE_qudi"))
        .args(["serve", "--listen", "127.0.0.1:0", "--device", devices])
        .env("QUDI_TOKEN", token)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut line = String::new();
    let mut output = BufReader::new(process.stdout.take().unwrap());
    output.read_line(&mut line).unwrap();
    let name = line.trim().strip_suffix(": cpu").unwrap().to_owned();
    Server { process, _output: output, name }
}

fn weights(folder: &Path, run: &str, devices: &str) -> Vec<u8> {
    let recipe = "--set train.steps=2 --set train.accumulate=2 --set data.crop=32 --set data.frames=3 \
        --set validation.crop=32 --set validation.frames=3";
    let arguments = format!("train tiny -o {run} --device {devices} -q {recipe}");
    qudi(folder).args(arguments.split_whitespace()).assert().success();
    std::fs::read(folder.join(run).join("weights.safetensors")).unwrap()
}

/// Returns the loss of the last step.
fn loss(folder: &Path, run: &str) -> f64 {
    let metrics = std::fs::read_to_string(folder.join(run).join("metrics.jsonl")).unwrap();
    let lines =
        metrics.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
    lines.filter_map(|line| line["total"].as_f64()).next_back().unwrap()
}

/// One server and two that share the batches give the same bits. Servers use Burn's own kernels.
#[test]
fn machines_share_batches_without_changing_the_result() {
    let folder = scratch("remote-train");
    let (near, far) = (serve("cpu", ""), serve("cpu,cpu", ""));
    let one = weights(&folder, "one", &near.name);
    let two = weights(&folder, "two", &format!("{},{}/1", near.name, far.name));
    assert!(one == two, "weights differ");
    weights(&folder, "own", "cpu");
    let [there, here] = ["one", "own"].map(|run| loss(&folder, run));
    assert!((there / here - 1.0).abs() < 1e-3, "{there} and {here}");
    let selftest = ["selftest", "--device", &far.name, "--only", "warp,convolution 3x3"];
    qudi(&folder).args(selftest).assert().success();
    refused(&folder, &format!("selftest --device {}/2", far.name), &["2 device(s)"]);
    refused(&folder, &format!("selftest --device {}/x", far.name), &["ws://HOST:PORT/1"]);
}

#[test]
fn server_requires_the_token() {
    let folder = scratch("remote-token");
    let server = serve("cpu", "lamp");
    let device = ["selftest", "--only", "arithmetic", "--device", &server.name];
    qudi(&folder).env("QUDI_TOKEN", "lamp").args(device).assert().success();
    refused(&folder, &device.join(" "), &["QUDI_TOKEN"]);
    refused(&folder, "serve --listen 0.0.0.0:0 --device cpu", &["QUDI_TOKEN", "0.0.0.0:0"]);
}
