//! Pages in a browser: pictures play, controls work, nothing of a name runs.

use crate::browser::Browser;
use crate::support::{run, scratch};
use std::path::Path;

fn url(path: &Path) -> String {
    let path = path.display().to_string();
    let escape = |byte: u8| match byte {
        b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'/' | b'.' | b'-' | b'_' => {
            char::from(byte).to_string()
        }
        other => format!("%{other:02X}"),
    };
    format!("file://{}", path.bytes().map(escape).collect::<String>())
}

/// A sum over the pixels of the large picture, which differs for different pictures.
const PIXELS: &str = "(() => { const c = document.querySelector('.stage canvas'); \
    const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; \
    let sum = 0; for (let i = 0; i < d.length; i++) sum = (sum * 31 + d[i]) % 1000000007; return sum; })()";

const DRAWN: &str = "document.querySelector('.player').player.incomplete === false";

#[test]
fn controls_of_a_page_work_with_pointer_and_keyboard() {
    let folder = scratch("pages-controls");
    run(
        &folder,
        "eval scene:text --size 48x64 --frames 11 --method average,mle --ppp 9.75 --html p.html -q",
    );
    let Some(mut browser) = Browser::start(&folder) else { return };
    browser.open(&url(&folder.join("p.html")), 1440);
    browser.wait_for(DRAWN);
    // It plays by itself, until it is stopped.
    let time = "+document.querySelector('.time').value";
    let before = browser.evaluate(time);
    browser.wait_for(&format!("{time} !== {before}"));
    browser.evaluate("document.querySelector('.stage canvas').focus()");
    browser.press(" ", Some(" "));
    browser.wait_for("document.querySelector('.play').textContent === 'Play'");
    browser.evaluate("document.querySelector('.player').player.go(4)");
    browser.wait_for(&format!("{time} === 4 && {DRAWN}"));

    browser.press("ArrowRight", None);
    browser.wait_for(&format!("{time} === 5"));
    browser.press("ArrowLeft", None);
    browser.wait_for(&format!("{time} === 4"));
    browser.press("+", Some("+"));
    browser.wait_for("document.querySelector('.stage.zoomed')");
    browser.press("0", Some("0"));
    browser.wait_for("!document.querySelector('.stage.zoomed')");

    // The slider, and errors with their key.
    let pixels = browser.evaluate(PIXELS);
    browser.evaluate("{ const s = document.querySelector('.split'); s.value = 10; s.dispatchEvent(new Event('input')); }");
    browser.wait_for(&format!("{DRAWN} && {PIXELS} !== {pixels}"));
    assert_eq!(browser.evaluate("document.querySelector('.key').hidden"), true);
    browser.evaluate(
        "{ const s = document.querySelector('[data-side=right]'); \
         s.value = [...s.options].findIndex(o => o.text === 'error of mle'); s.dispatchEvent(new Event('change')); }",
    );
    browser.wait_for(&format!("{DRAWN} && !document.querySelector('.key').hidden"));
    let key = browser.evaluate("document.querySelector('.key').textContent");
    assert!(key.as_str().unwrap().contains("0.25 or more"), "{key}");
    assert_eq!(
        browser.evaluate("document.querySelector('.tag.right').textContent"),
        "error of mle"
    );
    browser.evaluate("document.querySelectorAll('.all button')[0].click()");
    browser.wait_for("document.querySelector('[data-side=right]').value === '0'");

    // Every control has a name, and can be reached by the keyboard.
    let nameless = "[...document.querySelectorAll('button, select, input, canvas[tabindex]')].filter(e => \
        !(e.ariaLabel || e.textContent.trim()) || e.tabIndex < 0).length";
    assert_eq!(browser.evaluate(nameless), 0);

    // Narrow, and dark.
    for width in [800, 390] {
        browser.resize(width);
        browser.wait_for(&format!("document.documentElement.scrollWidth <= {width}"));
    }
    let dark = "getComputedStyle(document.body).backgroundColor.match(/\\d+/g).every(v => +v < 60)";
    browser.prefer("light");
    browser.wait_for(&format!("!({dark})"));
    browser.prefer("dark");
    browser.wait_for(dark);
    assert!(browser.said.is_empty(), "{:?}", browser.said);
}

#[test]
fn names_with_markup_are_shown_and_do_not_run() {
    let folder = scratch("pages-markup");
    let name = "<img src=x onerror=document.title='run'><script>document.title='run'<&.npy";
    run(&folder, "simulate scene:text --size 32x40 --frames 5 --seed 1 -o b.npy -q");
    std::fs::rename(folder.join("b.npy"), folder.join(name)).unwrap();
    // Its record names a sensor like markup, too.
    let record = std::fs::read_to_string(folder.join("b.npy.json")).unwrap();
    let mut record: serde_json::Value = serde_json::from_str(&record).unwrap();
    record["simulation"]["sensor"]["name"] = "<img src=x onerror=document.title='run'>".into();
    std::fs::write(folder.join(format!("{name}.json")), record.to_string()).unwrap();
    for args in [
        vec!["look", name, "-o", "page.html", "-q"],
        vec!["restore", name, "--method", "mle", "-o", "o.npy", "--html", "page.html", "-q", "-f"],
        vec!["eval", name, "--capture", "--method", "mle", "--html", "page.html", "-q", "-f"],
    ] {
        let command = args[0];
        crate::support::qudi(&folder).args(args).assert().success();
        let page = std::fs::read_to_string(folder.join("page.html")).unwrap();
        assert!(page.contains("&lt;img src=x") && !page.contains("<img src=x"), "{command}");
        let Some(mut browser) = Browser::start(&folder) else { continue };
        browser.open(&url(&folder.join("page.html")), 1000);
        browser.wait_for(DRAWN);
        assert_ne!(browser.evaluate("document.title"), "run", "{command}");
        assert_eq!(browser.evaluate("document.images.length"), 0, "{command}");
        assert!(
            browser.evaluate("document.body.textContent").as_str().unwrap().contains("<img src=x")
        );
        assert!(browser.said.is_empty(), "{command}: {:?}", browser.said);
    }
}

/// Pages are opened where nothing may be written, and after they were moved.
#[cfg(unix)]
#[test]
fn pages_need_no_rights_and_no_place() {
    use std::os::unix::fs::PermissionsExt;
    let folder = scratch("pages-sealed");
    run(&folder, "simulate scene:text --size 32x40 --frames 5 --seed 1 -o b.npy -q");
    run(&folder, "look b.npy -o look.html -q");
    run(&folder, "restore b.npy --method mle -o o.npy --html restore.html -q");
    run(&folder, "eval b.npy --capture --method mle --html eval.html -q");
    let sealed = folder.join("sealed #1? é");
    std::fs::create_dir(&sealed).unwrap();
    for page in ["look.html", "restore.html", "eval.html"] {
        std::fs::rename(folder.join(page), sealed.join(page)).unwrap();
        let mode = std::fs::Permissions::from_mode(0o444);
        std::fs::set_permissions(sealed.join(page), mode).unwrap();
    }
    std::fs::set_permissions(&sealed, std::fs::Permissions::from_mode(0o555)).unwrap();
    if let Some(mut browser) = Browser::start(&folder) {
        for page in ["look.html", "restore.html", "eval.html"] {
            browser.open(&url(&sealed.join(page)), 1000);
            browser.wait_for(DRAWN);
            assert!(browser.said.is_empty(), "{page}: {:?}", browser.said);
        }
    }
    // The administrator may write anywhere but where the kernel keeps its own files.
    let is_open = std::fs::write(sealed.join("probe"), "").is_ok();
    let place = if is_open { Path::new("/proc") } else { sealed.as_path() };
    std::fs::set_permissions(&sealed, std::fs::Permissions::from_mode(0o755)).unwrap();
    if is_open && !cfg!(target_os = "linux") {
        return;
    }
    if !is_open {
        std::fs::set_permissions(&sealed, std::fs::Permissions::from_mode(0o555)).unwrap();
    }
    let before = crate::support::listing(&folder);
    for args in [
        "look b.npy -o",
        "restore b.npy --method mle -o frames --html",
        "eval b.npy --capture --method mle --html",
        "eval scene:text --size 32x40 --frames 3 --method mle --html",
    ] {
        let page = place.join("page.html");
        let args: Vec<_> = args.split(' ').map(Into::into).chain([page.into_os_string()]).collect();
        let output = crate::support::qudi(&folder).args(&args).output().unwrap();
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{args:?}: {text}");
        for part in ["error: cannot create the output", "where: ", "page.html", "help: "] {
            assert!(text.contains(part), "{args:?}: no `{part}` in\n{text}");
        }
        assert_eq!(crate::support::listing(&folder), before, "{args:?}: nothing half-written");
    }
    std::fs::set_permissions(&sealed, std::fs::Permissions::from_mode(0o755)).unwrap();
}

/// The page of a training plays its validation.
#[test]
fn a_training_plays_its_validation() {
    let folder = scratch("pages-train");
    run(
        &folder,
        "train tiny -o run --device cpu -q --set train.steps=2 --set data.crop=32 --set data.frames=3 \
         --set validation.crop=32 --set validation.frames=5 --set validation.every=1",
    );
    let report = folder.join("run/report.html");
    assert!(std::fs::metadata(&report).unwrap().len() < 3_000_000);
    let Some(mut browser) = Browser::start(&folder) else { return };
    browser.open(&url(&report), 1000);
    browser.wait_for(DRAWN);
    let layers = "[...document.querySelector('[data-side=left]').options].map(o => o.text).join()";
    assert_eq!(browser.evaluate(layers), "counts,restored,truth,error of restored");
    assert_eq!(browser.evaluate("document.querySelector('.time').max"), "4");
    assert!(browser.said.is_empty(), "{:?}", browser.said);
}

#[test]
fn demo_shows_its_scenes_in_small_files() {
    let folder = scratch("pages-demo");
    let text = run(&folder, "demo -o d.png --animate --seed 3 --device cpu");
    for part in [
        "photograph, centre frame",
        "chart, centre frame",
        "qudi-regression errs by 0.",
        "it predicts, without the truth, 0.",
        "d.png   qudi-paper at 3.25 photons/pixel/frame, seed 3",
    ] {
        assert!(text.contains(part), "no `{part}` in\n{text}");
    }
    let size = |name: &str| std::fs::metadata(folder.join(name)).unwrap().len();
    assert!(size("d.html") <= 3_000_000, "{}", size("d.html"));
    assert!(size("d.gif") <= 2_000_000, "{}", size("d.gif"));
    assert_eq!(image::image_dimensions(folder.join("d.gif")).unwrap().0 % 4, 0);
    let Some(mut browser) = Browser::start(&folder) else { return };
    browser.open(&url(&folder.join("d.html")), 1440);
    let all = "[...document.querySelectorAll('.player')].every(e => e.player.incomplete === false)";
    browser.wait_for(all);
    assert_eq!(browser.evaluate("document.querySelectorAll('.player').length"), 2);
    assert_eq!(browser.evaluate("document.querySelectorAll('.all button').length"), 14);
    assert!(browser.said.is_empty(), "{:?}", browser.said);
}

#[test]
fn restored_frames_play_with_uncertainty_and_misfit() {
    let folder = scratch("pages-restore");
    run(&folder, "simulate scene:text --size 32x40 --frames 11 --ppp 9.75 --seed 1 -o b.npy -q");
    run(&folder, "restore b.npy -o o.npy --device cpu --html page.html -q");
    let page = std::fs::read_to_string(folder.join("page.html")).unwrap();
    for part in
        ["\"name\":\"qudi\"", "\"name\":\"uncertainty\"", "\"name\":\"misfit\"", "&quot;ppp&quot;"]
    {
        assert!(page.contains(part), "{part}");
    }
    crate::support::refused(
        &folder,
        "restore b.npy --method mle -o parts --shard 1/2 --html q.html",
        &["--html", "all the frames"],
    );
    crate::support::refused(&folder, "restore b.npy --method mle -o q.npy --html q.png", &["HTML"]);
    crate::support::refused(
        &folder,
        "restore b.npy --method mle -o q.npy --html page.html",
        &["page.html"],
    );
}
