//! `qudi serve`: this machine's devices for programs on others.

use super::args::Serve;
use super::remote;
use crate::device;
use crate::error::Result;
use crate::report::Report;
use serde_json::json;

pub(crate) fn run(args: &Serve, report: &Report) -> Result<()> {
    let opened = args.device.iter().map(|name| device::open(name)).collect::<Result<Vec<_>>>()?;
    let names: Vec<_> = opened.iter().map(|device| device.name.clone()).collect();
    let devices = opened.into_iter().map(|device| device.device).collect();
    remote::serve(devices, args.listen, |address| {
        let list = names.iter().enumerate().map(|(number, name)| match number {
            0 => format!("{}{address}: {name}", device::REMOTE),
            number => format!("{}{address}/{number}: {name}", device::REMOTE),
        });
        let text = list.collect::<Vec<_>>().join("\n");
        report.result(&text, || json!({"address": address.to_string(), "devices": names}))
    })
}
