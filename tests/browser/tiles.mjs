// Large surfaces in tiles: levels, atoms, colours, limits, and a lost connection.
import { assert, assertClean, browser, deferred, difference, drop, run, stablePicture, start, waitForMesh, SERVICE_URL, TIMEOUT_MS } from "./lib.mjs";

const chromium = await browser();
const page = await start(chromium);
const WARNING = /tiles versions at 1.1 or higher have limited support/;

/** Returns a block with nx × ny × nz atoms, 3 Å apart. */
function block(nx, ny, nz) {
  const lines = [];
  for (let i = 0; i < nx * ny * nz; i += 1) {
    const place = [Math.floor(i / (ny * nz)), Math.floor(i / nz) % ny, i % nz].map((c) => (3 * c).toFixed(3).padStart(8)).join("");
    const [serial, residue] = [(i + 1) % 100_000, (Math.floor(i / 64) % 9_999) + 1];
    lines.push(`ATOM  ${String(serial).padStart(5)}  CA  ALA A${String(residue).padStart(4)}    ${place}  1.00  0.00           ${i % 2 ? "C" : "N"}`);
  }
  return Buffer.from(lines.join("\n"));
}

/** Returns a bar of 2,100 × 24 × 24 Å with 44,800 atoms. Its tileset has two levels of subtrees. */
const bar = () => block(700, 8, 8);

const now = (of = page) => of.locator("#now").textContent();
/** Waits until all tiles of the view are loaded, and returns their number, triangles and finest spacing. */
async function settled(of = page) {
  await of.waitForFunction(
    () => {
      const text = document.querySelector("#now").textContent;
      const isStill = /tiles?, /.test(text) && !text.includes("loading") && window.lastTiles === text;
      window.lastTiles = text;
      return isStill;
    },
    null,
    { timeout: TIMEOUT_MS, polling: 400 },
  );
  const [, tiles, triangles, spacing] = /^(\d+) tiles?, ([\d,]+) triangles, ([\d.]+)/.exec(await now(of));
  return { tiles: Number(tiles), triangles: Number(triangles.replaceAll(",", "")), spacing: Number(spacing) };
}
async function zoom(steps) {
  const box = await page.locator("#view").boundingBox();
  await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
  for (let i = 0; i < steps; i += 1) {
    await page.mouse.wheel(0, -400);
    await page.waitForTimeout(20);
  }
}
const tileRequests = () => page.requests.filter((line) => line.includes("surface.glb?") && line.includes("tile="));

await run({
  "a small surface has no tiles": async () => {
    assert.match(await now(), /^[\d,]+ triangles/);
    assert.ok(await page.locator("#coarse").isHidden());
    assert.deepEqual(page.requests.filter((line) => line.includes("tileset")), []);
  },
  "instances of a large unit are shown as tiles at their placements": async () => {
    // As in the file, 200 Å away, and turned by a quarter.
    const operators = [[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], [[1, 0, 0, 0], [0, 1, 0, 200], [0, 0, 1, 0]], [[0, -1, 0, 300], [1, 0, 0, 0], [0, 0, 1, 0]]];
    const line = (row, k, serial) =>
      `REMARK 350   BIOMT${k + 1} ${String(serial + 1).padStart(3)}${row.slice(0, 3).map((v) => v.toFixed(6).padStart(10)).join("")}${row[3].toFixed(5).padStart(15)}`;
    const rules = operators.flatMap((rows, serial) => rows.map((row, k) => line(row, k, serial)));
    const header = ["REMARK 350 BIOMOLECULE: 1", "REMARK 350 APPLY THE FOLLOWING TO CHAINS: A", ...rules, ""].join("\n");
    const own = await start(chromium, { viewport: { width: 500, height: 400 } });
    await waitForMesh(own, () => drop(own, "blocks.pdb", Buffer.concat([Buffer.from(header), block(48, 28, 24)])));
    const structure = new URL(own.url()).searchParams.get("structure");
    const shown = async (pairs) => {
      await own.goto(`${SERVICE_URL}/?structure=${structure}&camera=20,10,1&resolution=0.5${pairs}`);
      const state = await settled(own);
      return { ...state, picture: await stablePicture(own) };
    };
    const instances = await shown("&assembly=1&instances=true");
    const wanted = (text) => own.requests.map(decodeURIComponent).filter((line) => line.includes(text));
    assert.ok(instances.tiles >= 3, await now(own));
    assert.ok(wanted("tileset.json?").some((line) => line.includes("unit=1")), "the tileset of the unit");
    assert.ok(wanted("tile=0/0/0/0").some((line) => line.includes("instances=true")), "the root");
    const [joined, unit] = [await shown("&assembly=1"), await shown("")];
    const [same, other] = [joined, unit].map(({ picture }) => difference(instances.picture, picture));
    assert.ok(same < 0.1 && other > 0.5, `${same} and ${other} of the silhouette differ from those of the assembly and of one copy`);
    assertClean(own, WARNING);
    await own.context().close();
  },
  "a large one opens in tiles, coarse ones first": async () => {
    await drop(page, "bar.pdb", bar());
    const { tiles, triangles, spacing } = await settled();
    assert.ok(tiles > 1 && triangles > 1000 && spacing > 1, await now());
    assert.ok(await page.locator("#coarse").isVisible());
    assert.match(decodeURIComponent(tileRequests()[0]), /tile=0\/0\/0\/0/);
    assert.ok(page.requests.some((line) => line.includes("/tileset.json?")));
  },
  "the report and the sizes are those of the mesh that the buttons download": async () => {
    const [area, volume] = ["area", "volume"].map((name) => page.locator(`#report tr[data-row="${name}"] td`));
    // The grid of the whole mesh exceeds the limit of this service.
    await area.getByText("not available: The grid would be too large").waitFor();
    assert.match(await page.locator("#size").textContent(), /^GLB: The grid would be too large/);
    assert.doesNotMatch(await volume.textContent(), /\d/);
    // A service without this limit.
    const released = deferred();
    await page.route("**/v1/estimate", (route) => {
      const { resolution, compress } = route.request().postDataJSON();
      return route.fulfill({ json: { accepted: true, problem: null, triangles: 8e6, mesh_bytes: resolution ? 50e6 : compress ? 70e6 : 200e6 } });
    });
    await page.route(/\/report\.json/, async (route) => {
      await released.promise;
      await route.fulfill({ json: { atoms: 44_800, area: 123_456, volume: 654_321, closed: true } });
    });
    await page.locator("#p-isovalue").fill("1.1");
    await page.locator("#p-isovalue").press("Enter");
    await area.getByText("computing…").waitFor();
    assert.doesNotMatch(await volume.textContent(), /\d/);
    const offers = page.locator("#size button");
    await offers.nth(1).waitFor();
    assert.match(await page.locator("#size").textContent(), /^GLB: about 8,000,000 triangles, 200.0 MB/);
    assert.deepEqual(await offers.allTextContents(), ["1 Å: 50.0 MB", "meshopt: 70.0 MB"]);
    released.resolve();
    await area.getByText("123,456 Å²").waitFor();
    assert.equal(await volume.textContent(), "654,321 Å³");
    const small = page.waitForRequest((request) => request.url().includes("/surface.glb?resolution=1&isovalue=1.1") && !request.url().includes("atom_ids"));
    await page.route(/surface\.glb\?resolution=1&isovalue=1\.1$/, (route) => route.fulfill({ body: "glTF" }));
    await offers.first().click();
    await small;
    for (const pattern of ["**/v1/estimate", /\/report\.json/, /surface\.glb\?resolution=1&isovalue=1\.1$/]) await page.unroute(pattern);
    await settled();
  },
  "finer tiles follow the view, from nested subtrees": async () => {
    const before = await settled();
    await zoom(25);
    const after = await settled();
    assert.ok(after.spacing === 0.5 && before.spacing > 1, `${before.spacing} ${after.spacing}`);
    assert.ok(after.triangles < 2.6e6 && after.tiles < 300, JSON.stringify(after));
    const subtrees = page.requests.filter((line) => line.includes("tileset.subtree")).map((line) => /tile=(\d+)/.exec(line)[1]);
    assert.ok(subtrees.includes("0") && subtrees.includes("4"), subtrees.join());
  },
  "atoms of tiles can be picked": async () => {
    const box = await page.locator("#view").boundingBox();
    await page.mouse.click(box.x + box.width / 2, box.y + box.height / 2);
    await page.waitForFunction(() => /ALA/.test(document.querySelector("#picked").textContent), null, { timeout: TIMEOUT_MS });
  },
  "colours of atoms need no new tiles": async () => {
    const before = tileRequests().length;
    await page.selectOption("#colour", "element");
    await page.waitForFunction(() => document.querySelector("#legend").textContent.includes("N"), null, { timeout: TIMEOUT_MS });
    await page.locator("#transparency").fill("40");
    await settled();
    assert.equal(tileRequests().length, before);
  },
  "a lost connection is reported, and tiles load again": async () => {
    assertClean(page, WARNING);
    await page.context().setOffline(true);
    await page.locator("#home").click();
    await page.mouse.wheel(0, 400);
    const box = await page.locator("#view").boundingBox();
    // A part of the bar that was not in view.
    await page.mouse.move(box.x + box.width * 0.9, box.y + box.height / 2);
    for (let i = 0; i < 25; i += 1) {
      await page.mouse.wheel(0, -400);
      await page.waitForTimeout(20);
    }
    await page.waitForFunction(() => /cannot be reached/.test(document.querySelector("#problem").textContent), null, { timeout: TIMEOUT_MS });
    await page.context().setOffline(false);
    await page.locator("#problem button", { hasText: "Try again" }).click();
    await settled();
    assert.ok(await page.locator("#problem").isHidden());
    // The browser has reported every failed request.
    page.errors.length = 0;
  },
  "another surface replaces the tiles": async () => {
    await page.locator("#sample").click();
    await page.waitForFunction(() => /^[\d,]+ triangles/.test(document.querySelector("#now").textContent), null, { timeout: TIMEOUT_MS });
    assert.ok(await page.locator("#coarse").isHidden());
    assertClean(page);
  },
  "without an index, the page requests one file": async () => {
    const problem = { type: "/problems/too-much-memory", title: "The request needs too much memory", status: 422 };
    const refuse = (route) => route.fulfill({ status: 422, contentType: "application/problem+json", body: JSON.stringify(problem) });
    const other = await start(chromium, { url: `${SERVICE_URL}/?pdb=1crn`, before: (p) => p.route(/[?&]tile=/, refuse) });
    assert.match(await other.locator("#now").textContent(), /^[\d,]+ triangles/);
    assert.ok(other.requests.some((line) => line.includes("tile=")), "no tile was requested");
    assert.ok(await other.locator("#problem").isHidden());
    await other.context().close();
  },

  "the component shows tilesets": async () => {
    const other = await page.context().newPage();
    await other.goto(SERVICE_URL);
    await other.evaluate(async (src) => {
      await import("/molmesh-viewer.js");
      const viewer = document.createElement("molmesh-viewer");
      viewer.style.cssText = "width: 400px; height: 300px";
      viewer.addEventListener("molmesh-tiles", ({ detail }) => (window.tiles = detail));
      viewer.addEventListener("molmesh-error", ({ detail }) => (window.failed = detail.message));
      viewer.src = src;
      document.body.append(viewer);
    }, "/v1/pdb/4pti/tileset.json?resolution=0.25&atom_ids=true");
    await other.waitForFunction(() => window.failed || (window.tiles?.tiles > 0 && !window.tiles.loading), null, { timeout: TIMEOUT_MS });
    assert.equal(await other.evaluate(() => window.failed ?? null), null);
    assert.ok((await other.evaluate(() => window.tiles.triangles)) > 1000);
  },
});
