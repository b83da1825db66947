//! Reports: pages, tables, and escape sequences in text.

use crate::support::{listing, npy_bytes, qudi, scratch};

/// Writes a gray clip of eleven frames.
fn write_clip(path: &std::path::Path, height: usize, width: usize) {
    let data: Vec<u8> = (0..11 * height * width)
        .flat_map(|i| (0.2 + 0.6 * ((i % width) as f32 / width as f32)).to_le_bytes())
        .collect();
    let shape = format!("(11, {height}, {width})");
    std::fs::write(path, npy_bytes("<f4", &shape, &data)).unwrap();
}

/// Writes a clip of eleven images into a folder.
fn write_images(folder: &std::path::Path, height: u32, width: u32) {
    std::fs::create_dir_all(folder).unwrap();
    for n in 0..11 {
        let image = image::GrayImage::from_fn(width, height, |x, y| {
            image::Luma([(40 + 3 * x + y + n) as u8])
        });
        image.save(folder.join(format!("{n:02}.png"))).unwrap();
    }
}

#[test]
fn page_shows_clips_of_two_sizes_under_their_full_names() {
    let folder = scratch("report-sizes");
    write_images(&folder.join("clips/run.1"), 32, 48);
    write_images(&folder.join("clips/run.2"), 40, 24);
    qudi(&folder)
        .args("eval clips --method mle --ppp 9.75 --html report.html --csv frames.csv".split(' '))
        .assert()
        .success();
    let page = std::fs::read_to_string(folder.join("report.html")).unwrap();
    for part in ["<h2>run.1, ", "<h2>run.2, ", "aspect-ratio:48/32", "aspect-ratio:24/40"] {
        assert!(page.contains(part), "{part}");
    }
    let csv = std::fs::read_to_string(folder.join("frames.csv")).unwrap();
    assert!(csv.contains("\"run.1\"") && csv.contains("\"run.2\""), "{csv}");
}

#[test]
fn clips_of_two_formats_keep_their_extensions() {
    let folder = scratch("report-formats");
    std::fs::create_dir(folder.join("clips")).unwrap();
    write_clip(&folder.join("clips/dog.npy"), 32, 32);
    write_images(&folder.join("clips/dog"), 32, 32);
    qudi(&folder)
        .args("eval clips --method average --ppp 9.75 --csv frames.csv".split(' '))
        .assert()
        .success();
    let csv = std::fs::read_to_string(folder.join("frames.csv")).unwrap();
    assert!(csv.contains("\"dog\"") && csv.contains("\"dog.npy\""), "{csv}");
}

#[test]
fn page_names_regression_or_diffusion() {
    let folder = scratch("report-how");
    qudi(&folder)
        .args(
            "eval scene:text --method mle,qudi --ppp 3.25 --frames 11 --device cpu --html r.html"
                .split(' '),
        )
        .assert()
        .success();
    let page = std::fs::read_to_string(folder.join("r.html")).unwrap();
    assert!(page.contains("qudi (regression) on cpu: PSNR"), "the network's way");
    assert!(page.contains("mle over "), "the length that the method chose");
}

#[test]
fn rejects_impossible_outputs_before_the_work() {
    let folder = scratch("report-impossible");
    for option in ["--csv", "--html", "--markdown"] {
        // The clip does not exist either: the output is checked first.
        let output = qudi(&folder)
            .args(["eval", "missing.npy", option, "no/such/folder/file"])
            .assert()
            .code(2);
        let said = String::from_utf8_lossy(&output.get_output().stderr).into_owned();
        assert!(said.contains("no/such/folder/file"), "{option}: {said}");
    }
    assert!(listing(&folder).is_empty());
}

#[test]
fn csv_cells_cannot_become_formulas() {
    let folder = scratch("report-formula");
    std::fs::create_dir(folder.join("clips")).unwrap();
    write_clip(&folder.join("clips/=1+1.npy"), 32, 32);
    qudi(&folder)
        .args("eval clips --method average --ppp 9.75 --csv frames.csv".split(' '))
        .assert()
        .success();
    let csv = std::fs::read_to_string(folder.join("frames.csv")).unwrap();
    assert!(csv.contains("\"'=1+1\""), "{csv}");
}

#[test]
fn prints_control_characters_of_names_escaped() {
    let folder = scratch("report-control");
    let name = "a\u{1b}[31mb\u{9b}2J.npy";
    let error = qudi(&folder).args(["info", name]).assert().code(2);
    let said = String::from_utf8_lossy(&error.get_output().stderr).into_owned();
    assert!(!said.contains('\u{1b}') && !said.contains('\u{9b}'), "{said:?}");
    assert!(said.contains(r"a\u{1b}[31mb\u{9b}2J.npy"), "{said:?}");

    write_clip(&folder.join(name), 32, 32);
    for json in [&[][..], &["--json"]] {
        let shown = qudi(&folder).args(["info", name]).args(json).output().unwrap();
        for text in [shown.stdout, shown.stderr] {
            let text = String::from_utf8_lossy(&text).into_owned();
            assert!(!text.contains('\u{1b}') && !text.contains('\u{9b}'), "{text:?}");
        }
    }
}
