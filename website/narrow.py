"""Which pages of a built site scroll sideways on a phone, as headless Chromium lays them out."""

import functools
import json
import queue
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

WIDTH = 420
_SIDE_BY_SIDE = 4
_LONGEST = 300.0  # seconds
# Each page in a frame as wide as a phone. What sticks out of the page, and of no box that scrolls
# by itself, is named.
_MEASURE = """<!doctype html><meta charset="utf-8"><body><script>
const pages = PAGES, found = [];  // frames run no scripts: those change no widths
let next = 0, open = 0;
function culprit(doc, width) {
  for (const one of doc.querySelectorAll("body *")) {
    const box = one.getBoundingClientRect();
    if (box.width === 0 || box.right <= width + 1) continue;
    let outer = one.parentElement, held = getComputedStyle(one).position === "fixed";
    for (; outer && !held; outer = outer.parentElement)
      held = ["auto", "scroll", "hidden", "clip"].includes(getComputedStyle(outer).overflowX)
        && outer.getBoundingClientRect().right <= width + 1;
    if (!held) return one.tagName.toLowerCase() + "." + one.className + ": "
      + one.textContent.trim().slice(0, 60);
  }
  return "";
}
function measure() {
  if (next >= pages.length) {
    if (open === 0) fetch("/widths", {method: "POST", body: JSON.stringify(found)});
    return;
  }
  const page = pages[next++], frame = document.createElement("iframe");
  open += 1;
  frame.sandbox = "allow-same-origin";
  frame.style = "width: WIDTHpx; height: 800px; border: 0";
  frame.onload = () => {
    const doc = frame.contentDocument, root = doc.documentElement;
    const wide = Math.max(root.scrollWidth, doc.body.scrollWidth);
    const sticks = culprit(doc, WIDTH);
    if (wide > WIDTH || sticks) found.push(page + " (" + wide + " px) " + sticks);
    frame.remove();
    open -= 1;
    measure();
  };
  frame.src = "/" + page;
  document.body.append(frame);
}
for (let i = 0; i < SIDE; i++) measure();
</script>"""


def too_wide(site: Path, browser: str) -> list[str]:
    """Pages that are wider than a phone, with what sticks out.

    Raises:
        RuntimeError: the browser did not come to an end within five minutes.
    """
    pages = sorted(str(path.relative_to(site)) for path in site.rglob("*.html"))
    script = _MEASURE.replace("PAGES", json.dumps([p for p in pages if p != "404.html"]))
    script = script.replace("WIDTH", str(WIDTH)).replace("SIDE", str(_SIDE_BY_SIDE))
    answers: queue.Queue[list[str]] = queue.Queue()
    # The browser's own helpers may write into its profile a moment longer than it lives itself.
    folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
    with _served(site, script, answers) as address, folder as profile:
        line = [
            browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}",
            "--remote-debugging-port=0", "--window-size=1280,900", address,
        ]  # fmt: skip
        quiet = subprocess.DEVNULL
        with subprocess.Popen(line, stdout=quiet, stderr=quiet) as running:
            try:
                return answers.get(timeout=_LONGEST)
            except queue.Empty:
                raise RuntimeError("the browser did not measure all pages") from None
            finally:
                running.terminate()


@contextmanager
def _served(site: Path, script: str, answers: queue.Queue[list[str]]) -> Iterator[str]:
    """The site, and beside it the page that measures, at an address of this machine alone."""

    class Handler(SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path != "/measure":
                return super().do_GET()
            return self._answer(script.encode())

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            self._answer(b"")
            answers.put(json.loads(body))

        def _answer(self, body: bytes) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *args: object) -> None:
            """Nothing."""

    handler = functools.partial(Handler, directory=str(site))
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/measure"
    finally:
        server.shutdown()
