#!/usr/bin/env python3
"""Opens reports in a headless Chromium and prints what is wrong with them.

    tests/browser/check.py [--screenshots DIR] REPORT.html ...

The screens are those of a telephone (360 px) and a desktop (1280 px), each in light and dark
colours. A report must log no error, make no network request, be no wider than the screen and
smaller than 2 MB. Every figure must have a caption and something drawn. No text may leave its box,
be smaller than 10 px, or overlap the text of another tick. Folded parts are unfolded first.

Exit status: 0 if all is well, 1 if not (one line per fault), 3 without a browser, 4 if the browser
fails. The browser is one of chromium-headless-shell, chromium, chromium-browser, google-chrome, or
the one that CHROMIUM names. Nothing else is needed: the script controls the browser through its
debugging pipe (file descriptors 3 and 4, messages end with a zero byte).
"""

import argparse
import base64
import fcntl
import json
import os
import pathlib
import select
import shutil
import signal
import sys
import tempfile
import time

PROGRAMS = ["chromium-headless-shell", "chromium", "chromium-browser", "google-chrome"]
SCREENS = [(360, 780), (1280, 900)]
LARGEST = 2_000_000
PATIENCE = 60.0

# Runs in the page and returns the faults as text.
LOOK = r"""
(() => {
  const faults = [];
  const what = e => {
    const names = e.className && e.className.baseVal === undefined ? '.' + e.className : '';
    return `${e.tagName.toLowerCase()}${names} "${e.textContent.trim().slice(0, 40)}"`;
  };
  document.querySelectorAll('details').forEach(d => { d.open = true; });
  const wide = document.documentElement.clientWidth;
  if (document.documentElement.scrollWidth > wide) {
    const page = document.documentElement.scrollWidth;
    faults.push(`the page is ${page} px wide, the screen ${wide} px`);
  }
  if (!document.querySelector('h1')) faults.push('no heading');
  for (const figure of document.querySelectorAll('figure')) {
    const caption = figure.querySelector('figcaption');
    const name = caption ? caption.textContent.trim() : '';
    if (!name) faults.push('a figure without a caption');
    if (figure.querySelector('.none')) continue;
    const drawn = [...figure.querySelectorAll('svg path.line, svg path.dots')]
      .filter(p => (p.getAttribute('d') || '').length > 3);
    const box = figure.querySelector('svg') && figure.querySelector('svg').getBoundingClientRect();
    if (!drawn.length || !box || box.width < 100 || box.height < 80) {
      faults.push(`figure ${name}: nothing is drawn`);
    }
    for (const path of drawn) {
      const p = path.getBBox();
      if (p.width <= 0 && p.height <= 0 && !path.classList.contains('dots')) {
        faults.push(`figure ${name}: an empty path`);
      }
      if (getComputedStyle(path).stroke === 'none') {
        faults.push(`figure ${name}: a line without a colour`);
      }
    }
    for (const kind of ['x', 'y', 'm']) {
      const ticks = [...figure.querySelectorAll(`.plot > span.${kind}`)]
        .map(t => [t, t.getBoundingClientRect()]);
      if (kind !== 'm' && ticks.length < 2) {
        faults.push(`figure ${name}: fewer than two ticks along ${kind}`);
      }
      ticks.forEach(([t, a], i) => ticks.slice(i + 1).forEach(([u, b]) => {
        if (a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom) {
          faults.push(`figure ${name}: ${what(t)} overlaps ${what(u)}`);
        }
      }));
    }
  }
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  const seen = new Set();
  while (walker.nextNode()) {
    const text = walker.currentNode, e = text.parentElement;
    if (!text.data.trim() || ['SCRIPT', 'STYLE', 'TITLE'].includes(e.tagName)) continue;
    const range = document.createRange();
    range.selectNodeContents(text);
    const r = range.getBoundingClientRect();
    if (!r.width) continue;
    if (parseFloat(getComputedStyle(e).fontSize) < (e.closest('sup') ? 7 : 10)) {
      faults.push(`${what(e)} is smaller than 10 px`);
    }
    if (e.closest('.scroll')) continue;
    if (r.left < -0.5 || r.right > wide + 0.5) {
      const span = `${Math.round(r.left)} to ${Math.round(r.right)} px`;
      faults.push(`${what(e)} leaves the screen: ${span}`);
    }
    for (let box = e; box && box !== document.body; box = box.parentElement) {
      if (seen.has(box) || box.closest('.plot')) continue;
      seen.add(box);
      if (box.scrollWidth > box.clientWidth + 1 && getComputedStyle(box).display !== 'inline') {
        faults.push(`${what(box)} is wider than its box`);
      }
    }
  }
  return {
    faults,
    figures: document.querySelectorAll('figure').length,
    height: document.documentElement.scrollHeight,
  };
})()
"""


class Browser:
    """A headless browser and its debugging pipe."""

    def __init__(self, program):
        self.folder = tempfile.mkdtemp(prefix="report-browser-")
        to_read, self.to = os.pipe()
        self.answers, from_write = os.pipe()
        # Above 4, so that neither is overwritten before it is moved to 3 or 4.
        ends = [fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, 10) for fd in (to_read, from_write)]
        os.close(to_read)
        os.close(from_write)
        null = os.open(os.devnull, os.O_RDWR)
        arguments = [
            program,
            "--headless",
            "--remote-debugging-pipe",
            f"--user-data-dir={self.folder}",
            "--no-first-run",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--disable-extensions",
            "--disable-background-networking",
            "--disable-component-update",
            "--hide-scrollbars",
            "--host-resolver-rules=MAP * ~NOTFOUND",
        ]
        if os.getuid() == 0:
            arguments.append("--no-sandbox")
        self.pid = os.posix_spawn(
            program,
            [*arguments, "about:blank"],
            os.environ,
            file_actions=[
                (os.POSIX_SPAWN_DUP2, null, 0),
                (os.POSIX_SPAWN_DUP2, null, 1),
                (os.POSIX_SPAWN_DUP2, null, 2),
                (os.POSIX_SPAWN_DUP2, ends[0], 3),
                (os.POSIX_SPAWN_DUP2, ends[1], 4),
            ],
            setpgroup=0,
        )
        for fd in (*ends, null):
            os.close(fd)
        self.number, self.text, self.session, self.events = 0, b"", None, []

    def message(self, deadline):
        while b"\0" not in self.text:
            if not select.select([self.answers], [], [], max(0.0, deadline - time.monotonic()))[0]:
                raise TimeoutError("the browser does not answer")
            part = os.read(self.answers, 1 << 20)
            if not part:
                raise ConnectionError("the browser ended")
            self.text += part
        first, self.text = self.text.split(b"\0", 1)
        return json.loads(first)

    def call(self, method, **parameters):
        self.number += 1
        call = {"id": self.number, "method": method, "params": parameters}
        if self.session:
            call["sessionId"] = self.session
        os.write(self.to, json.dumps(call).encode() + b"\0")
        deadline = time.monotonic() + PATIENCE
        while True:
            message = self.message(deadline)
            if message.get("id") == self.number:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return message["result"]
            self.events.append(message)

    def wait_for(self, event):
        deadline = time.monotonic() + PATIENCE
        while not any(e.get("method") == event for e in self.events):
            self.events.append(self.message(deadline))

    def open_tab(self):
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def close(self):
        self.session = None
        try:
            self.call("Browser.close")
        except (OSError, RuntimeError):
            pass
        deadline = time.monotonic() + 10
        while os.waitpid(self.pid, os.WNOHANG)[0] == 0:
            if time.monotonic() > deadline:
                os.killpg(self.pid, signal.SIGKILL)
                os.waitpid(self.pid, 0)
                break
            time.sleep(0.02)
        shutil.rmtree(self.folder, ignore_errors=True)


def check(browser, file, screenshots):
    size = file.stat().st_size
    if size > LARGEST:
        yield f"{size} bytes: more than {LARGEST}"
    for width, height in SCREENS:
        browser.events.clear()
        browser.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=2 if width < 600 else 1,
            mobile=width < 600,
        )
        browser.call("Page.navigate", url=file.resolve().as_uri())
        browser.wait_for("Page.loadEventFired")
        before = browser.call(
            "Runtime.evaluate",
            expression="document.documentElement.scrollHeight",
            returnByValue=True,
        )["result"]["value"]
        schemes = ("light", "dark")
        if screenshots:
            for scheme in schemes:
                browser.call(
                    "Emulation.setEmulatedMedia",
                    features=[{"name": "prefers-color-scheme", "value": scheme}],
                )
                shoot(browser, screenshots / f"{file.stem}-{width}-{scheme}.png", width, before)
        for scheme in schemes:
            browser.call(
                "Emulation.setEmulatedMedia",
                features=[{"name": "prefers-color-scheme", "value": scheme}],
            )
            result = browser.call("Runtime.evaluate", expression=LOOK, returnByValue=True)
            if "exceptionDetails" in result:
                raise RuntimeError(result["exceptionDetails"])
            look = result["result"]["value"]
            for fault in dict.fromkeys(look["faults"]):
                yield f"{width} px, {scheme}: {fault}"
        if screenshots:
            browser.call(
                "Emulation.setEmulatedMedia",
                features=[{"name": "prefers-color-scheme", "value": "light"}],
            )
            shoot(browser, screenshots / f"{file.stem}-{width}-unfolded.png", width, look["height"])
        for event in browser.events:
            method, parameters = event.get("method"), event.get("params", {})
            if method == "Runtime.exceptionThrown" or (
                method == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "warning")
            ):
                yield f"{width} px: the console says {json.dumps(parameters)[:300]}"
            elif method == "Log.entryAdded" and parameters["entry"]["level"] in (
                "error",
                "warning",
            ):
                yield f"{width} px: the browser says {parameters['entry']['text']}"
            elif method == "Network.requestWillBeSent":
                url = parameters["request"]["url"]
                if url != file.resolve().as_uri() and not url.startswith("data:"):
                    yield f"{width} px: it asks for {url}"


def shoot(browser, name, width, height):
    picture = browser.call(
        "Page.captureScreenshot",
        format="png",
        captureBeyondViewport=True,
        clip={"x": 0, "y": 0, "width": width, "height": min(height, 8000), "scale": 1},
    )
    name.write_bytes(base64.b64decode(picture["data"]))


def main():
    parser = argparse.ArgumentParser(description="Checks reports in a headless browser.")
    parser.add_argument(
        "--screenshots", type=pathlib.Path, help="a folder for pictures of each report"
    )
    parser.add_argument("reports", nargs="+", type=pathlib.Path)
    options = parser.parse_args()
    names = [os.environ["CHROMIUM"]] if os.environ.get("CHROMIUM") else PROGRAMS
    program = next((p for p in map(shutil.which, names) if p), None)
    if program is None:
        print(f"no browser: none of {', '.join(names)} is installed", file=sys.stderr)
        return 3
    if options.screenshots:
        options.screenshots.mkdir(parents=True, exist_ok=True)
    bad = False
    browser = Browser(program)
    try:
        browser.open_tab()
        for report in options.reports:
            for fault in check(browser, report, options.screenshots):
                bad = True
                print(f"{report}: {fault}")
    finally:
        browser.close()
    return 1 if bad else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, RuntimeError) as error:
        print(f"the browser failed: {error}", file=sys.stderr)
        sys.exit(4)
