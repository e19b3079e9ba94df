"""Open every page of the site in a browser, at the widths of a desk and a phone, light and dark; print what is wrong.

    make docs && python docs/browse.py                   # needs PyQt6-WebEngine, which is Chromium; no network

A page is wrong where a script reports an error, a picture does not load, the page is wider than its window, a figure to
turn stays empty, what can be clicked has no name for a screen reader or is not reached by the keyboard, or a picture
stays the same when an arrow key is pressed on its control or the mouse drags it. `--pictures` keeps what a page looks
like, at its top and at each of these pictures.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
os.environ.setdefault("QTWEBENGINE_CHROMIUM_FLAGS", "--no-sandbox --disable-gpu")

from PyQt6.QtCore import QEventLoop, QPoint, Qt, QUrl
from PyQt6.QtGui import QImage
from PyQt6.QtTest import QTest
from PyQt6.QtWebEngineCore import QWebEnginePage
from PyQt6.QtWebEngineWidgets import QWebEngineView
from PyQt6.QtWidgets import QApplication

SITE = Path(__file__).resolve().parents[1] / "site"
WIDTHS, HEIGHT = (1280, 390), 900
#: Schemes of Material for MkDocs, and milliseconds until a page's scripts have drawn, and a key has had its effect.
SCHEMES, WAIT, SOON = ("default", "slate"), 900, 250
#: Pixels of a drag, which is a few pictures of a strip.
DRAG = 60
#: Returns the faults of a page in a scheme, in words.
FAULTS = """
document.body.setAttribute("data-md-color-scheme", "%s");
const seen = each => each.offsetParent !== null;
const name = each => (each.innerText || each.ariaLabel || each.title || each.alt || "").trim()
  || [...each.querySelectorAll("img[alt], svg, [title], [aria-label]")].length || [...(each.labels || [])].length;
const wide = document.documentElement.scrollWidth - window.innerWidth;
const faults = wide > 1 ? [`${wide} pixels wider than the window`] : [];
for (const image of document.images) if (image.src && !image.naturalWidth) faults.push(`no picture ${image.src}`);
for (const image of document.images) if (!image.hasAttribute("alt")) faults.push(`no words for ${image.src}`);
const frames = [...document.querySelectorAll("iframe:not([title])")].filter(seen);
for (const frame of frames) faults.push(`no title ${frame.src}`);
const content = document.querySelector("article") || document.body;
for (const each of content.querySelectorAll("a[href], button, input, select")) {
  if (seen(each) && !name(each)) faults.push(`no name: ${each.outerHTML.slice(0, 80)}`);
  if (seen(each) && each.tabIndex < 0) faults.push(`not reached by the keyboard: ${each.outerHTML.slice(0, 80)}`);
}
for (const each of document.querySelectorAll("canvas")) if (seen(each) && !each.width) faults.push("an empty canvas");
faults;
"""
#: Returns how many controls have a picture; and of one its name, whether its picture can be dragged, and where that is.
CONTROLS = """
window.controls = [...document.querySelectorAll(".turn[role=slider], .between input[type=range], select#choose")];
controls.length;
"""
AT = """(() => {
const control = controls[%d], figure = control.closest("figure") || document;
const picture = figure.querySelector(".turn, #solid");
picture.scrollIntoView({ block: "center", behavior: "instant" });
const { left, top, width, height } = picture.getBoundingClientRect();
const place = [left, top, width, height].map(Math.round);
return [control.ariaLabel || control.id, picture.matches(".turn"), ...place];
})()"""


class Page(QWebEnginePage):
    """A page that keeps what its scripts report as errors."""

    def __init__(self, *parts: object) -> None:
        super().__init__(*parts)
        self.errors: list[str] = []

    def javaScriptConsoleMessage(self, level, message, line, source) -> None:
        if level == QWebEnginePage.JavaScriptConsoleMessageLevel.ErrorMessageLevel:
            self.errors.append(f"{message} ({source}:{line})")


class Browser:
    """Opens pages one after the other, and returns their faults."""

    def __init__(self, pictures: Path | None) -> None:
        self.pictures, self.view = pictures, QWebEngineView()
        self.view.setPage(Page(self.view))
        self.view.show()

    def faults(self, page: Path, width: int, scheme: str) -> list[str]:
        self.view.resize(width, HEIGHT)
        loop = QEventLoop()
        self.view.loadFinished.connect(loop.quit)
        self.view.load(QUrl.fromLocalFile(str(page)))
        loop.exec()
        self.view.loadFinished.disconnect(loop.quit)
        QTest.qWait(WAIT)
        found = self.run(FAULTS % scheme)
        found = ["scripts cannot run"] if found is None else found
        stem = "-".join(page.relative_to(SITE).with_suffix("").parts)
        self.keep(f"{stem}-{width}-{scheme}")
        for k in range(self.run(CONTROLS) or 0):
            found += self.use(k)
            self.keep(f"{stem}-{width}-{scheme}-{k}")
        errors = self.view.page().errors
        found, errors[:] = [*found, *errors], []
        return found

    def use(self, k: int) -> list[str]:
        """Press an arrow key on a control, and drag its picture if it turns; return what did not change the picture."""
        name, turns, *box = self.run(AT % k)
        QTest.qWait(SOON)
        self.run(f"controls[{k}].focus()")
        faults = []
        for way, act in (("the right arrow", self.press), ("a drag", self.drag))[: 1 + turns]:
            before = self.picture(box)
            act(box)
            QTest.qWait(SOON)
            faults += [f"{way} does not change: {name}"] * (self.picture(box) == before)
        return faults

    def press(self, box: list[int]) -> None:
        QTest.keyClick(self.view.focusProxy(), Qt.Key.Key_Right)

    def drag(self, box: list[int]) -> None:
        left, top, width, height = box
        hand, middle = self.view.focusProxy(), QPoint(left + width // 2, top + height // 2)
        QTest.mousePress(hand, Qt.MouseButton.LeftButton, pos=middle)
        QTest.mouseMove(hand, middle + QPoint(DRAG, 0), 20)
        QTest.mouseRelease(hand, Qt.MouseButton.LeftButton, pos=middle + QPoint(DRAG, 0), delay=20)

    def picture(self, box: list[int]) -> QImage:
        return self.view.grab().toImage().copy(*box)

    def keep(self, name: str) -> None:
        if self.pictures:
            QTest.qWait(SOON)
            self.view.grab().save(str(self.pictures / f"{name}.png"))

    def run(self, script: str) -> Any:
        """Return a script's value, None where scripts cannot run."""
        loop, values = QEventLoop(), []
        self.view.page().runJavaScript(script, lambda value: (values.append(value), loop.quit()))
        loop.exec()
        return values[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", type=Path, help="by default all of site/")
    parser.add_argument("--pictures", type=Path, help="a folder for pictures of the pages")
    options = parser.parse_args()
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    app = QApplication(sys.argv[:1])
    browser, wrong = Browser(options.pictures), dict[Path, None]()
    pages = [page.resolve() for page in options.pages] or sorted(SITE.rglob("*.html"))
    for page, width, scheme in itertools.product(pages, WIDTHS, SCHEMES):
        for fault in browser.faults(page, width, scheme):
            print(f"{page.relative_to(SITE)} ({width}, {scheme}): {fault}", flush=True)
            wrong[page] = None
    print(f"{len(wrong)} of {len(pages)} pages are wrong")
    del browser, app
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
