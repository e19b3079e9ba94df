"""Open every page of the site in a browser, at the widths of a desk and a phone, light and dark; print what is wrong.

    make docs && python docs/browse.py                   # needs PyQt6-WebEngine, which is Chromium; no network

A page is wrong where a script reports an error, a picture does not load, the page is wider than its window, a figure to
turn stays empty, or what can be clicked has no name for a screen reader or is not reached by the keyboard.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
os.environ.setdefault("QTWEBENGINE_CHROMIUM_FLAGS", "--no-sandbox --disable-gpu")

from PyQt6.QtCore import QTimer, QUrl
from PyQt6.QtWebEngineCore import QWebEnginePage
from PyQt6.QtWebEngineWidgets import QWebEngineView
from PyQt6.QtWidgets import QApplication

SITE = Path(__file__).resolve().parents[1] / "site"
WIDTHS, HEIGHT = (1280, 390), 900
#: Schemes of Material for MkDocs, and milliseconds until a page's scripts have drawn.
SCHEMES, WAIT = ("default", "slate"), 900
#: Returns the faults of a page in a scheme, in words.
FAULTS = """
document.body.setAttribute("data-md-color-scheme", "%s");
const seen = each => each.offsetParent !== null;
const name = each => (each.innerText || each.ariaLabel || each.title || each.alt || "").trim()
  || [...each.querySelectorAll("img[alt], svg, [title], [aria-label]")].length || [...(each.labels || [])].length;
const wide = document.documentElement.scrollWidth - window.innerWidth;
const faults = wide > 1 ? [`${wide} pixels wider than the window`] : [];
for (const image of document.images) if (image.complete && !image.naturalWidth) faults.push(`no picture ${image.src}`);
for (const image of document.images) if (!image.hasAttribute("alt")) faults.push(`no words for ${image.src}`);
for (const each of document.querySelectorAll("article :is(a[href], button, input, select)")) {
  if (seen(each) && !name(each)) faults.push(`no name: ${each.outerHTML.slice(0, 80)}`);
  if (seen(each) && each.tabIndex < 0) faults.push(`not reached by the keyboard: ${each.outerHTML.slice(0, 80)}`);
}
for (const each of document.querySelectorAll("canvas")) if (seen(each) && !each.width) faults.push("an empty canvas");
faults;
"""


class Page(QWebEnginePage):
    """A page that keeps what its scripts report as errors."""

    def __init__(self, *parts: object) -> None:
        super().__init__(*parts)
        self.errors: list[str] = []

    def javaScriptConsoleMessage(self, level, message, line, source) -> None:
        if level == QWebEnginePage.JavaScriptConsoleMessageLevel.ErrorMessageLevel:
            self.errors.append(f"{message} ({source}:{line})")


class Browser:
    """Opens pages one after the other, and keeps their faults."""

    def __init__(self, app: QApplication, pages: list[Path]) -> None:
        self.app, self.faults, self.count = app, dict[str, None](), len(pages)
        self.jobs = [(page, width, scheme) for page in pages for width in WIDTHS for scheme in SCHEMES]
        self.view = QWebEngineView()
        self.view.setPage(Page(self.view))
        self.view.loadFinished.connect(lambda _: QTimer.singleShot(WAIT, self.ask))
        self.view.show()

    def open(self) -> None:
        if not self.jobs:
            return self.app.quit()
        page, width, _ = self.jobs[0]
        self.view.resize(width, HEIGHT)
        return self.view.load(QUrl.fromLocalFile(str(page)))

    def ask(self) -> None:
        self.view.page().runJavaScript(FAULTS % self.jobs[0][2], self.note)

    def note(self, found: list[str] | None) -> None:
        page, width, scheme = self.jobs.pop(0)
        errors = self.view.page().errors
        for fault in (*(found or ["scripts cannot run"] * (found is None)), *errors):
            self.faults[f"{page.relative_to(SITE)} ({width}, {scheme}): {fault}"] = None
        errors.clear()
        self.open()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", type=Path, help="by default all of site/")
    options = parser.parse_args()
    app = QApplication(sys.argv[:1])
    browser = Browser(app, [page.resolve() for page in options.pages] or sorted(SITE.rglob("*.html")))
    QTimer.singleShot(0, browser.open)
    app.exec()
    print("\n".join(browser.faults))
    print(f"{len({fault.partition(' (')[0] for fault in browser.faults})} of {browser.count} pages are wrong")
    sys.exit(bool(browser.faults))


if __name__ == "__main__":
    main()
