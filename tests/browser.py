"""A page as Debian's chromium shows it without a screen: what it loads, says and draws, and where."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from mpitled.results.markup import POLICY

#: Asks the page, once it is there, and leaves the answer in it. Boxes are of what has text or pictures of its own.
_ASK = """
<script>
const said = [];
for (const kind of ["error", "warn"]) console[kind] = (...words) => said.push(words.join(" "));
addEventListener("error", event => said.push(event.message || "not loaded: " + event.target.src), true);
addEventListener("securitypolicyviolation", event => said.push("refused: " + event.blockedURI));
addEventListener("load", () => {
  const of = "h1, h2, h3, p, a, img, figcaption, caption, th, td, li, summary, b, span";
  const shown = [...document.querySelectorAll(of)];
  const boxes = shown.filter(element => element.checkVisibility()).map(element => {
    const box = element.getBoundingClientRect();
    return {what: element.tagName + " " + (element.alt || element.textContent).slice(0, 40),
            box: [box.left, box.top, box.right, box.bottom],
            cut: element.scrollWidth > element.clientWidth + 1 && getComputedStyle(element).display != "inline",
            scrolls: element.closest(".wide, pre") !== null,
            inside: shown.map((other, i) => other !== element && other.contains(element) ? i : -1).filter(i => i >= 0)};
  });
  const answer = document.createElement("script");
  answer.type = "application/json";
  answer.id = "answer";
  answer.textContent = JSON.stringify({
    said: said,
    fetched: performance.getEntriesByType("resource").map(of => of.name).filter(name => !name.startsWith("data:")),
    pictures: [...document.images].map(image => [image.alt, image.naturalWidth, image.naturalHeight]),
    width: [document.documentElement.scrollWidth, innerWidth],
    boxes: boxes,
  });
  document.body.append(answer);
});
</script>
"""


def shown(page: Path, width: int, folder: Path) -> dict[str, Any]:
    """What the browser has to say of a page in a window of that width. Skips where there is no browser."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        pytest.skip("no chromium: apt-get install chromium")
    text = page.read_text(encoding="utf-8")
    assert POLICY in text
    asked = folder / f"asked_{width}.html"
    asked.write_text(text.replace(POLICY, POLICY + "; script-src 'unsafe-inline'").replace("<head>", "<head>" + _ASK))
    command = [
        browser, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
        f"--user-data-dir={folder / 'profile'}", f"--window-size={width},2000", "--virtual-time-budget=5000",
        "--dump-dom", asked.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=os.environ, check=True)
    answer = re.search(r'<script type="application/json" id="answer">(.*?)</script>', done.stdout, re.DOTALL)
    assert answer, done.stderr
    return dict(json.loads(answer[1]))


def overlaps(answer: dict[str, Any]) -> list[str]:
    """Pairs of boxes, neither in the other, that share more than a pixel, and what is cut off or beyond the page."""
    boxes, found = answer["boxes"], []
    for i, one in enumerate(boxes):
        left, top, right, bottom = one["box"]
        if one["cut"] and not one["scrolls"]:
            found.append(f"cut: {one['what']}")
        for j, other in enumerate(boxes[:i]):
            across = min(right, other["box"][2]) - max(left, other["box"][0])
            down = min(bottom, other["box"][3]) - max(top, other["box"][1])
            if across > 1 and down > 1 and j not in one["inside"] and i not in other["inside"]:
                found.append(f"{one['what']} / {other['what']}")
    return found
