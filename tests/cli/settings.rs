//! Settings: every command applies a key or refuses it by name, wherever the key comes from.

use crate::support::{qudi, scratch};
use std::path::Path;

/// A short run of every command, with the parts of the settings that it takes.
const COMMANDS: &[(&str, &[&str])] = &[
    ("simulate scene:text --size 16x16 --frames 3 -o s.npy -f", &["simulate", "sensor"]),
    ("eval scene:text --frames 11 --ppp 9.75 --method average", &["simulate", "sensor"]),
    ("restore b.npy --method average -o r.npy -f", &["sensor"]),
    ("info b.npy", &["sensor"]),
    ("calibrate d.npy --sensor swissspad2 -o c.toml -f", &["sensor"]),
    ("light --lux 1", &["sensor"]),
    ("demo --device none", &["sensor"]),
    ("train tiny -o t --device none", &["network", "data", "train", "validation"]),
    ("bench --size 16x16 --frames 3 --rounds 1 --method average", &[]),
    ("bench --train tiny --device none", &["network", "data", "train", "validation"]),
    ("convert b.npy -o copy.npy -f", &[]),
    ("publish none.safetensors -o w.safetensors", &[]),
    ("selftest --only none", &[]),
    ("completions bash", &[]),
];

/// A key and a possible value of every part, and one of each part that does not exist.
const KEYS: &[(&str, &str, &str)] = &[
    ("simulate", "simulate.seed=3", "simulate.sed=3"),
    ("sensor", "sensor.pitch_um=5.5", "sensor.pitch=5.5"),
    ("network", "network.fold=2", "network.fld=2"),
    ("data", "data.source.0.weight=2.0", "data.source.0.wait=2.0"),
    ("train", "train.steps=3", "train.stepz=3"),
    ("validation", "validation.every=9", "validation.evry=9"),
    ("total", "", "total.nonsense=1"),
];

fn prepared(name: &str) -> std::path::PathBuf {
    let folder = scratch(name);
    for (sensor, name) in [("qudi-paper", "b.npy"), ("swissspad2", "d.npy")] {
        qudi(&folder)
            .args("simulate scene:text --size 32x32 --frames 60 --ppp 0.05 --seed 1 -q".split(' '))
            .args(["-o", name, "--sensor", sensor])
            .assert()
            .success();
    }
    folder
}

fn said(folder: &Path, command: &str, rest: &[&str]) -> String {
    let output = qudi(folder).args(command.split(' ')).args(rest).output().unwrap();
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn every_command_applies_or_rejects_set_keys_by_name() {
    let folder = prepared("settings-set");
    for (command, takes) in COMMANDS {
        let verb = command.split(' ').next().unwrap();
        for (part, known, unknown) in KEYS {
            let text = said(&folder, command, &["--set", unknown]);
            let key = unknown.split('=').next().unwrap();
            assert!(text.contains(&format!("unknown key `{key}`")), "{command}: {text}");
            if known.is_empty() {
                continue;
            }
            let text = said(&folder, command, &["--set", known]);
            let key = known.split('=').next().unwrap();
            let refusal = format!("`{key}` is not a setting of `qudi {verb}");
            assert_eq!(text.contains(&refusal), !takes.contains(part), "{command} {known}: {text}");
        }
    }
}

#[test]
fn files_and_the_environment_are_shared_between_commands() {
    let folder = prepared("settings-shared");
    let all = "[simulate]\nseed = 3\n[sensor]\npitch_um = 5.5\n[train]\nsteps = 3\n\
        ablate = [\"flow\"]\n[[data.source]]\nname = \"a\"\n";
    std::fs::write(folder.join("all.toml"), all).unwrap();
    std::fs::write(folder.join("typo.toml"), "[train]\nstepz = 3\n").unwrap();
    for (command, _) in COMMANDS {
        let text = said(&folder, command, &["--config", "all.toml"]);
        assert!(!text.contains("not a setting of"), "{command}: {text}");
        assert!(!text.contains("unknown key"), "{command}: {text}");
        let text = said(&folder, command, &["--config", "typo.toml"]);
        assert!(text.contains("did you mean `train.steps`"), "{command}: {text}");
        let output = qudi(&folder).args(command.split(' ')).env("QUDI_SENSOR_BIT", "3").output();
        let text = String::from_utf8_lossy(&output.unwrap().stderr).into_owned();
        assert!(text.contains("did you mean `QUDI_SENSOR_BITS`"), "{command}: {text}");
    }
}

/// Accepted keys change the result.
#[test]
fn applies_keys_that_a_command_takes() {
    let folder = prepared("settings-applied");
    let json = |args: &str| -> serde_json::Value {
        let args = format!("{args} --json");
        let output = qudi(&folder).args(args.split(' ')).output().unwrap();
        assert!(output.status.success(), "{args}: {}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let eval = "eval scene:text --method average";
    let found = json(&format!(
        "{eval} --set sensor.bits=2 --set simulate.ppp=5 --set simulate.frames=12 --set simulate.seed=7"
    ));
    assert_eq!(found["sensor"]["bits"], 2);
    assert_eq!(found["seed"], 7);
    assert_eq!(found["rows"].as_array().unwrap().len(), 1);
    assert_eq!(found["rows"][0]["ppp"], 5.0);
    assert_eq!(found["rows"][0]["clips"][0]["frames"].as_array().unwrap().len(), 12);
    let found = json("restore b.npy --method average -o r.npy --set sensor.quantum_efficiency=0.4");
    assert_eq!(found["settings"]["sensor"]["quantum_efficiency"], 0.4);
    let [plain, twice] = ["0.8", "0.4"].map(|efficiency| {
        json(&format!("info b.npy --set sensor.quantum_efficiency={efficiency}"))["ppp"]["incident"]
            .as_f64()
            .unwrap()
    });
    assert!((twice / plain - 2.0).abs() < 0.2, "{plain} {twice}");
    let light = json("light --lux 1 --set sensor.pitch_um=10 --set sensor.fps=100");
    assert_eq!(light["assumptions"]["pitch_um"], 10.0);
    json("calibrate d.npy --sensor swissspad2 -o c.toml --set sensor.fps=50");
    let sensor = std::fs::read_to_string(folder.join("c.toml")).unwrap();
    assert!(sensor.contains("fps = 50"), "{sensor}");
    assert!(!sensor.contains("base ="), "a preset with changes is written out: {sensor}");
}
