"""The pool of the page for browsers stays closed towards the root, in Node.js."""

import json
import shutil
import subprocess

import pytest

import web_pages

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="needs node")

# Trees of 63 pages, of which page 62 is the coarsest: page p is below page 32 + p / 2.
PROGRAM = """
import { PagePool } from "POOL";
let state = 1;
const random = (most) => {
  state = (48271 * state) % 2147483647;
  return state % most;
};
const PAGES = 63;
const file = {
  numPages: PAGES,
  mostPageBytes: 100,
  bytesOf: (page) => 60 + (page % 5) * 10,
  pageAbove: (page) => (page === PAGES - 1 ? -1 : 32 + (page >> 1)),
};
const report = { put: 0, refused: 0, open: 0, evictedInUse: 0, sharedSlots: 0, most: 0 };
const pool = new PagePool([file, file], 2 * file.bytesOf(PAGES - 1) + 12 * 100);
[0, 1].forEach((bundle) => pool.putRoot(bundle));
let used = new Set();
for (let frame = 1; frame < 400; frame += 1) {
  const wanted = [0, 1].flatMap((bundle) => {
    const needs = new Float32Array(PAGES);
    for (let k = 0; k < 3; k += 1) needs[random(PAGES - 1)] = 1 + random(8);
    return pool.recordNeeds(bundle, needs, frame);
  });
  const isResident = (key) => pool.pages[key[0]].isResident(Number(key.slice(2)));
  used = new Set();
  pool.pages.forEach(({ lastNeeded }, bundle) => {
    lastNeeded.forEach((last, page) => {
      if (last === frame && isResident(`${bundle}/${page}`)) used.add(`${bundle}/${page}`);
    });
  });
  for (const { bundle, page } of wanted.toSorted((a, b) => b.priority - a.priority)) {
    if (!pool.mayPut(bundle, page)) continue;
    if (pool.put(bundle, page, frame) < 0) report.refused += 1;
    else report.put += 1;
  }
  report.evictedInUse += [...used].filter((key) => !isResident(key)).length;
  const places = [];
  pool.pages.forEach((pages, bundle) => {
    for (let page = 0; page < PAGES - 1; page += 1) {
      if (!pages.isResident(page)) continue;
      places.push(pages.places[page]);
      if (!pages.isResident(file.pageAbove(page))) report.open += 1;
    }
  });
  report.sharedSlots += places.length - new Set(places).size;
  report.most = Math.max(report.most, places.length);
}
console.log(JSON.stringify(report));
"""


def test_pages_come_after_and_leave_before_those_above(tmp_path):
    program = tmp_path / "pool.mjs"
    program.write_text(PROGRAM.replace("POOL", (web_pages.WEB / "page_pool.js").as_uri()))
    done = subprocess.run(["node", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["open"] == report["evictedInUse"] == report["sharedSlots"] == 0
    assert report["most"] == 12
    assert report["put"] > 200
    assert report["refused"] > 0
