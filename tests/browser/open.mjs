// Open surfaces and instances on the page: both sides of a patch, all instances of an assembly, and their downloads.
import { readFileSync } from "node:fs";
import path from "node:path";
import {
  assert, assertClean, browser, difference, drop, fetchUncompressed, inverted, maskOf, open, plainColor, run, silhouette, stablePicture, start,
  waitForMesh, ROOT, SERVICE_URL, TIMEOUT_MS,
} from "./lib.mjs";

const chromium = await browser();
// Small, because surfaces are compared by their pictures.
const viewport = { width: 640, height: 600 };

/**
 * Opens a page and returns a picture of its surface, the luminance of its colour, and the result of `act`. Meshes go
 * through `change` first.
 */
async function shown(url, change, act) {
  const before = (page) => change && page.route("**/surface.glb*", async (route) => {
    const response = await fetchUncompressed(route);
    await route.fulfill({ response, body: change(await response.body()) });
  });
  const page = await open(chromium, { url, viewport, before });
  await page.waitForFunction(() => window.measures.length > 0, null, { timeout: TIMEOUT_MS });
  await page.mouse.move(1, 1);
  const [picture, plain] = [await stablePicture(page), await plainColor(page)];
  const result = await act?.(page);
  assertClean(page);
  await page.context().close();
  return { picture, plain, result };
}

/** Returns a copy of a GLB whose material shows outer sides only. */
function oneSided(bytes) {
  const copy = Buffer.from(bytes);
  const at = copy.indexOf('"doubleSided":true');
  assert.ok(at > 0, "the material is not two-sided");
  copy.write('"doubleSided":null', at);
  return copy;
}

/** Returns the mean luminance of the pixels in `mask`. */
function luminance({ data }, mask) {
  const values = mask.flatMap((set, i) => (set ? [0.2126 * data[4 * i] + 0.7152 * data[4 * i + 1] + 0.0722 * data[4 * i + 2]] : []));
  return values.reduce((sum, value) => sum + value, 0) / values.length / 255;
}

await run({
  "both sides of a patch are drawn and lit": async () => {
    // Half of crambin, from the cut (azimuth 0) and from outside.
    const patch = (azimuth) => `${SERVICE_URL}/?pdb=1crn&resolution=1&context=whole&select=resi+1-23&camera=${azimuth},5,1`;
    const { picture: inside, plain } = await shown(patch(0));
    const { picture: outside } = await shown(patch(180));
    const { picture: outerSides } = await shown(patch(0), oneSided);
    const [pixels, opposite, fewer] = [inside, outside, outerSides].map((picture) => silhouette(picture).pixels);
    // Opposite views of one surface have mirrored silhouettes, apart from the perspective.
    assert.ok(Math.abs(pixels / opposite - 1) < 0.05, `${pixels} and ${opposite} pixels`);
    assert.ok(fewer < 0.8 * pixels, `${fewer} of ${pixels} pixels show outer sides`);
    // The pixels that show inner sides are as bright as others. Normals that point away would make them dark.
    const [all, outer] = [maskOf(inside), maskOf(outerSides)];
    const inner = all.map((set, i) => set && !outer[i]);
    const turned = await shown(patch(0), inverted);
    const [bright, dark] = [luminance(inside, inner), luminance(turned.picture, outer)];
    assert.ok(bright > 0.85 * plain, `inner sides have the luminance ${bright}, the colour has ${plain}`);
    assert.ok(dark < 0.85 * plain, `sides with normals that point away have the luminance ${dark}`);
    // A click on an inner side finds its atom; without inner sides, none. The pixel has neighbours on all sides.
    const { width } = inside;
    const around = [0, 1, -1, width, -width].flatMap((by) => [by, 5 * by]);
    const at = inner.findIndex((_, i) => around.every((by) => inner[i + by]));
    assert.ok(at > 0, "no inner side is large enough for a click");
    const click = async (page) => {
      await page.locator("#view").click({ position: { x: at % width, y: Math.floor(at / width) } });
      return page.locator("#picked").textContent();
    };
    const { result: found } = await shown(patch(0), undefined, click);
    const { result: none } = await shown(patch(0), oneSided, click);
    assert.match(found, /chain A, protein/);
    assert.match(none, /Point at the surface/);
  },

  "all instances of an assembly are drawn, each in its place": async () => {
    const page = await start(chromium, { viewport });
    // DNA with an antibiotic, and an assembly of two copies.
    const complex = readFileSync(path.join(ROOT, "tests/structures/1pfe.cif.gz"));
    await waitForMesh(page, () => drop(page, "1pfe.cif.gz", complex));
    const { searchParams } = new URL(page.url());
    const linked = (pairs) => `${SERVICE_URL}/?structure=${searchParams.get("structure")}&camera=60,80,0.9${pairs}`;
    const { picture: instances } = await shown(linked("&assembly=1&instances=true"));
    const { picture: joined } = await shown(linked("&assembly=1"));
    const { picture: unit } = await shown(linked(""));
    const [same, other] = [difference(instances, joined), difference(unit, joined)];
    assert.ok(same < 0.06, `${same} of the silhouette differs from that of the joined surface`);
    assert.ok(other > 0.2, `${other} of the silhouette of one copy differs from that of the assembly`);
    await page.context().close();
  },

  "downloads of instances are files that the service can make": async () => {
    const page = await start(chromium, { viewport });
    const complex = readFileSync(path.join(ROOT, "tests/structures/1pfe.cif.gz"));
    await waitForMesh(page, () => drop(page, "1pfe.cif.gz", complex));
    assert.ok(!(await page.locator("#joined").isVisible()));
    const { searchParams } = new URL(page.url());
    const url = `${SERVICE_URL}/?structure=${searchParams.get("structure")}&resolution=2&assembly=1&instances=true`;
    const other = await open(chromium, { url, viewport });
    await other.waitForFunction(() => window.measures.length > 0, null, { timeout: TIMEOUT_MS });
    assert.ok(await other.locator("#joined").isVisible());
    const curl = other.locator("#curl");
    for (const format of ["glb", "gltf", "stl", "ply", "png"]) {
      const saved = other.waitForEvent("download");
      await other.locator(`[data-format="${format}"]`).click();
      await saved;
      const request = other.requests.filter((line) => line.includes(`/surface.${format}`)).at(-1);
      const repeats = ["glb", "gltf"].includes(format);
      assert.ok(request.includes("assembly=1") && request.includes("instances=true") === repeats, request);
      await other.locator("#format").selectOption(format);
      assert.equal((await curl.textContent()).includes("instances=true"), repeats, format);
    }
    assertClean(other);
  },

  "without WebGL, the picture of instances is that of the joined surface": async () => {
    const flat = await browser("--disable-3d-apis");
    const page = await open(flat, { url: `${SERVICE_URL}/?pdb=4pti&resolution=2&assembly=1&instances=true`, viewport });
    await page.locator("#picture").waitFor({ timeout: TIMEOUT_MS });
    assert.ok(await page.evaluate(() => document.querySelector("#picture").naturalWidth > 0));
    const request = page.requests.find((line) => line.includes("/surface.png"));
    assert.ok(request.includes("assembly=1") && !request.includes("instances"), request);
    await flat.close();
  },
});
