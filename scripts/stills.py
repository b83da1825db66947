#!/usr/bin/env python3
"""Makes the stills of the documentation: runs the commands below, and photographs their pages in Chromium.

python3 scripts/stills.py [NAME ...]    writes docs/images/NAME.jpg, by default all

`qudi` and `chromium` must be on the PATH; QUDI and CHROMIUM name others. No other package is needed.
"""

import base64
import contextlib
import fcntl
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs/images"
PHOTOGRAPH = ROOT / "crates/qudi-cli/assets/melons.jpg"
QUDI = os.environ.get("QUDI", "qudi")
CHROMIUM = os.environ.get("CHROMIUM", "chromium")
# Bytes of a still at most; the highest JPEG quality that keeps it is taken.
MAX_BYTES = 150_000
QUALITIES = (90, 85, 80, 72, 64, 55, 45)

# Commands by the file that they make. The documentation prints them below the stills.
COMMANDS = {
    "burst.npy": "simulate photograph.jpg --motion pan:2.4,-0.9+rotate:0.4 --size 256x256 --frames 33 --ppp 3.25 "
    "--seed 1 -o burst.npy",
    "mosaic.npy": "simulate photograph.jpg --motion pan:2.4,-0.9+rotate:0.4 --size 256x256 --frames 11 --cfa rggb "
    "--ppp 3.25 --seed 1 -o mosaic.npy",
    "look.html": "look burst.npy -o look.html",
    "uncertainty.html": "restore burst.npy -o restored.npy --html uncertainty.html",
    "colour.html": "restore mosaic.npy -o colours.npy --html colour.html",
    "demo.png": "demo --diffusion -o demo.png",
}

# What is photographed: the page, its size, the element (by default the top of the page), the place of the
# slider and the pictures under it.
SHOTS = {
    "demo-page": dict(page="demo.html", after="demo.png", width=1280, height=900, split=0.5),
    "look": dict(page="look.html", needs=["burst.npy"], width=1200, height=860, split=0.5),
    "view": dict(page=None, needs=["burst.npy"], width=620, height=960, split=0.5),
    "colour": dict(page="colour.html", needs=["mosaic.npy"], width=700, height=1400, element=".stage", split=0.4),
    "uncertainty": dict(
        page="uncertainty.html", needs=["burst.npy"], width=700, height=1400, element=".stage", split=0.5, sides=("qudi", "uncertainty")
    ),
}


class Browser:
    """Chromium with one page, driven through a pipe by the protocol of its developer tools."""

    def __init__(self, folder: Path):
        to_browser, self.out = os.pipe()
        self.into, from_browser = os.pipe()

        # The protocol's pipe is the descriptors 3 and 4, which these may be already.
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (to_browser, from_browser)]

        def connect():
            for end, number in zip(ends, (3, 4)):
                os.dup2(end, number)

        options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--remote-debugging-pipe"]
        self.process = subprocess.Popen(
            [CHROMIUM, *options, f"--user-data-dir={folder / 'profile'}", "about:blank"],
            preexec_fn=connect,
            close_fds=False,
            stderr=subprocess.DEVNULL,
        )
        self.sent, self.rest, self.session = 0, b"", None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call("Page.enable")

    def call(self, method: str, **params):
        self.sent += 1
        message = {"id": self.sent, "method": method, "params": params}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.out, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self.rest:
                self.rest += os.read(self.into, 1 << 20)
            text, self.rest = self.rest.split(b"\0", 1)
            answer = json.loads(text)
            if answer.get("id") == self.sent:
                return answer["result"]

    def evaluate(self, expression: str):
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        return result["result"].get("value")

    def open(self, url: str, width: int, height: int):
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.call("Page.navigate", url=url)
        self.wait("[...document.querySelectorAll('.player')].every(e => e.player?.incomplete === false)")

    def wait(self, expression: str):
        for _ in range(1200):
            if self.evaluate(f"document.readyState === 'complete' && ({expression})"):
                return
            time.sleep(0.1)
        raise SystemExit(f"never true: {expression}")

    def photograph(self, clip=None) -> bytes:
        for quality in QUALITIES:
            options = {"format": "jpeg", "quality": quality} | ({"clip": clip} if clip else {})
            jpeg = base64.b64decode(self.call("Page.captureScreenshot", **options)["data"])
            if len(jpeg) <= MAX_BYTES:
                break
        return jpeg

    def close(self):
        self.process.terminate()
        self.process.wait()


def make(folder: Path, file: str):
    """Runs the command that makes a file, once."""
    if not (folder / file).exists():
        command = COMMANDS[file]
        print(f"qudi {command}", flush=True)
        subprocess.run([QUDI, *command.split(), "-q"], cwd=folder, check=True)


@contextlib.contextmanager
def served(folder: Path, capture: str):
    """Serves the page of `qudi view`."""
    print(f"qudi view {capture}", flush=True)
    process = subprocess.Popen(
        [QUDI, "view", capture], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        yield process.stdout.readline().strip()
    finally:
        process.terminate()
        process.wait()


def shoot(browser: Browser, folder: Path, name: str):
    shot = SHOTS[name]
    for file in shot.get("needs", []):
        make(folder, file)
    with contextlib.ExitStack() as stack:
        if shot["page"] is None:
            url = stack.enter_context(served(folder, "burst.npy"))
        else:
            make(folder, shot.get("after", shot["page"]))
            url = (folder / shot["page"]).as_uri()
        browser.open(url, shot["width"], shot.get("height", 900))
        sides = json.dumps(shot.get("sides"))
        browser.evaluate(
            f"""(() => {{
                for (const {{ player }} of document.querySelectorAll('.player')) {{
                    player.play(false);
                    const sides = {sides};
                    if (sides) ['left', 'right'].forEach((side, n) =>
                        player.choose(side, player.views.findIndex(view => view.name === sides[n])));
                    player.split = {shot["split"]};
                    player.go(Math.floor(player.scene.frames / 2));
                }}
            }})()"""
        )
        time.sleep(0.3)
        browser.wait("[...document.querySelectorAll('.player')].every(e => e.player.incomplete === false)")
        clip = None
        if element := shot.get("element"):
            box = browser.evaluate(
                f"(b => ({{x: b.x, y: b.y, width: b.width, height: b.height, scale: 1}}))"
                f"(document.querySelector({element!r}).getBoundingClientRect())"
            )
            clip = box
        (IMAGES / f"{name}.jpg").write_bytes(browser.photograph(clip))


def main():
    names = sys.argv[1:] or [*SHOTS, "diffusion"]
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        shutil.copyfile(PHOTOGRAPH, folder / "photograph.jpg")
        browser = Browser(folder)
        try:
            for name in names:
                if name == "diffusion":
                    make(folder, "demo.png")
                    shutil.copyfile(folder / "demo.jpg", IMAGES / "diffusion.jpg")
                else:
                    shoot(browser, folder, name)
                print(f"docs/images/{name}.jpg: {(IMAGES / f'{name}.jpg').stat().st_size} bytes", flush=True)
        finally:
            browser.close()


if __name__ == "__main__":
    main()
