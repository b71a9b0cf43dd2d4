// Open surfaces and instances on the page: both sides of a patch, all instances of an assembly, and their downloads.
import { readFileSync } from "node:fs";
import path from "node:path";
import {
  assert, assertClean, browser, drop, glb, open, picture, plainColor, run, silhouette, stablePicture, start, waitForMesh,
  ROOT, SERVICE_URL, TIMEOUT_MS,
} from "./lib.mjs";

const chromium = await browser();
const viewport = { width: 640, height: 600 };
/** A patch of the surface of crambin, from the side with the azimuth `azimuth`. */
const patch = (azimuth) =>
  `${SERVICE_URL}/?pdb=1crn&resolution=1&context=whole&select=resi+1-23&camera=${azimuth},5,1`;

/** Opens a page, waits for its surface, and returns a picture of it. Requests of meshes go through `change`. */
async function seen(url, change) {
  const before = (page) => change && page.route("**/surface.glb*", async (route) => {
    const reply = await route.fetch();
    await route.fulfill({ response: reply, body: change(await reply.body()) });
  });
  const page = await open(chromium, { url, viewport, before });
  await page.waitForFunction(() => window.measures.length > 0, null, { timeout: TIMEOUT_MS });
  await page.mouse.move(1, 1);
  const found = { ...silhouette(await stablePicture(page)), plain: await plainColor(page) };
  assertClean(page);
  await page.context().close();
  return found;
}

/** Returns a copy of a GLB whose material shows the outer side only. */
function oneSided(bytes) {
  const copy = Buffer.from(bytes);
  const at = copy.indexOf('"doubleSided":true');
  assert.ok(at > 0, "the material is not two-sided");
  copy.write('"doubleSided":null', at);
  return copy;
}

/** Compares the silhouettes of two pictures: the share of their pixels that belong to one of them only. */
function difference(a, b) {
  const background = (p, i) => [0, 1, 2].every((c) => Math.abs(p.data[i + c] - p.data[4 * Math.floor(i / 4 / p.width) * p.width + 8 + c]) <= 6);
  let [one, any] = [0, 0];
  for (let i = 0; i < a.data.length; i += 4) {
    const [inA, inB] = [!background(a, i), !background(b, i)];
    if (inA || inB) any += 1;
    if (inA !== inB) one += 1;
  }
  assert.ok(any > 5000, "both pictures are empty");
  return one / any;
}

await run({
  "both sides of a patch are drawn and lit": async () => {
    for (const azimuth of [0, 90, 180, 270]) {
      const both = await seen(patch(azimuth));
      const outer = await seen(patch(azimuth), oneSided);
      const hidden = 1 - outer.pixels / both.pixels;
      console.log(azimuth, both, outer, hidden);
    }
  },

  "all instances of an assembly are drawn, each in its place": async () => {
    const page = await start(chromium, { viewport });
    // DNA with an antibiotic, and an assembly of two copies.
    const complex = readFileSync(path.join(ROOT, "tests/structures/1pfe.cif.gz"));
    await waitForMesh(page, () => drop(page, "1pfe.cif.gz", complex));
    const shown = async (pairs) => {
      const url = new URL(page.url());
      for (const [name, value] of Object.entries({ camera: "60,20,0.7", ...pairs })) url.searchParams.set(name, value);
      const other = await open(chromium, { url: url.href, viewport });
      await other.waitForFunction(() => window.measures.length > 0, null, { timeout: TIMEOUT_MS });
      await other.mouse.move(1, 1);
      return { page: other, picture: await stablePicture(other) };
    };
    const instances = await shown({ assembly: "1", instances: "true" });
    const joined = await shown({ assembly: "1" });
    console.log(difference(instances.picture, joined.picture));
    // Downloads.
  },
});
