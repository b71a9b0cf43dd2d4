// Shared code of the browser tests: a browser, pages that record requests and errors, and analysis of pictures.
//
// Environment: MOLMESH_URL (a running service), MOLMESH_MODULES (node_modules of the tests), MOLMESH_CHROMIUM (path of
// the browser), MOLMESH_ROOT (the repository).
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import path from "node:path";

const { MOLMESH_URL, MOLMESH_MODULES, MOLMESH_CHROMIUM, MOLMESH_ROOT } = process.env;
export const SERVICE_URL = MOLMESH_URL;
export const MODULES = MOLMESH_MODULES;
export const ROOT = MOLMESH_ROOT;
export const require = createRequire(path.join(MODULES, "x.js"));
export const { chromium } = require("playwright-core");
const sharp = require("sharp");
/** Maximum time of one step, ms. A machine that runs ten other tests may need minutes. */
export const TIMEOUT_MS = 180_000;

/** Starts a browser that reaches only this machine. A software GPU renders WebGL, but not the page around it. */
export async function browser(...flags) {
  const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-gpu-compositing", "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1", ...flags];
  return chromium.launch({ executablePath: MOLMESH_CHROMIUM, args, timeout: TIMEOUT_MS });
}

/**
 * Opens a page in a new context. It records its requests (`requests`), its errors and warnings (`errors`), and the
 * responses that report a problem (`problems`).
 */
export async function open(browser, options = {}) {
  const { url = SERVICE_URL + "/", before, ...rest } = options;
  const context = await browser.newContext({ viewport: { width: 1120, height: 600 }, reducedMotion: "reduce", acceptDownloads: true, ...rest });
  context.setDefaultTimeout(TIMEOUT_MS);
  const page = await context.newPage();
  page.errors = [];
  page.requests = [];
  page.problems = [];
  // Composition without a GPU reads each canvas back, which the driver reports as slow.
  const isProblem = (message) => ["error", "warning"].includes(message.type()) && !message.text().includes("GPU stall due to ReadPixels");
  page.on("console", (message) => isProblem(message) && page.errors.push(`${message.type()}: ${message.text()}`));
  page.on("pageerror", (error) => page.errors.push(`exception: ${error.message}`));
  page.on("request", (request) => page.requests.push(`${request.method()} ${request.url()}`));
  page.on("response", async (response) => {
    if (response.status() >= 400) page.problems.push(`${response.url()}: ${await response.text().catch(String)}`);
  });
  await page.addInitScript(() => {
    window.measures = [];
    new PerformanceObserver((list) => window.measures.push(...list.getEntries().map((e) => ({ ms: e.duration, ...e.detail })))).observe({ type: "measure", buffered: true });
    document.addEventListener("securitypolicyviolation", (e) => console.error(`policy: ${e.violatedDirective} ${e.blockedURI}`));
  });
  await before?.(page);
  await page.goto(url, { timeout: TIMEOUT_MS });
  return page;
}

/** Returns the number of surfaces that the page has shown, without previews. */
export const meshesShown = (page) => page.evaluate(() => window.measures.filter((e) => e.preview === null).length);

/** Runs `act` and waits for the next surface. */
export async function waitForMesh(page, act) {
  const before = await meshesShown(page);
  await act();
  await page.waitForFunction((n) => window.measures.filter((e) => e.preview === null).length > n, before, { timeout: TIMEOUT_MS });
}

/** Opens the page and waits for its first surface. */
export async function start(browser, options = {}) {
  const page = await open(browser, options);
  await page.waitForFunction(() => window.measures.length > 0, null, { timeout: TIMEOUT_MS });
  return page;
}

/** Moves a slider to `value`, 0 to 1000, with the events of a user's input. */
export const slide = (page, name, value) =>
  page.evaluate(
    ([name, value]) => {
      const slider = document.querySelector(`[data-slider="${name}"]`);
      slider.value = String(value);
      slider.dispatchEvent(new Event("input", { bubbles: true }));
      slider.dispatchEvent(new Event("change", { bubbles: true }));
    },
    [name, value],
  );

/** Drops a file on the page. */
export async function drop(page, name, bytes) {
  const data = await page.evaluateHandle(([name, text]) => {
    const transfer = new DataTransfer();
    transfer.items.add(new File([Uint8Array.from(atob(text), (c) => c.charCodeAt(0))], name));
    return transfer;
  }, [name, bytes.toString("base64")]);
  for (const type of ["dragover", "drop"]) await page.dispatchEvent("body", type, { dataTransfer: data });
}

/** Returns a number from the displayed report. */
export async function reportValue(page, row) {
  const text = await page.locator(`#report tr[data-row="${row}"] td`).textContent();
  return Number(text.replaceAll(",", "").split(" ")[0]);
}

/** Fails if a page has errors that match no pattern of `allowed`, or sent a request to another server. */
export function assertClean(page, ...allowed) {
  const errors = page.errors.filter((line) => !allowed.some((pattern) => pattern.test(line)));
  assert.deepEqual(errors, [], ["the page has errors", ...page.problems].join("\n"));
  const foreign = page.requests.filter((line) => !line.includes(` ${new URL(page.url()).origin}/`) && !line.includes(" blob:"));
  assert.deepEqual(foreign, [], "the page sent requests to other servers");
}

/** Runs scenarios in order. The first failure ends the process. */
export async function run(scenarios) {
  for (const [name, scenario] of Object.entries(scenarios)) {
    const startedAt = performance.now();
    try {
      await scenario();
      console.log(`ok ${name} (${((performance.now() - startedAt) / 1000).toFixed(1)} s)`);
    } catch (error) {
      console.log(`FAILED ${name}`);
      console.log(error.stack);
      process.exit(1);
    }
  }
  process.exit(0);
}

/** Takes a screenshot of the surface without its captions and controls. Returns width, height and RGBA bytes. */
export async function picture(page, selector = "#view-home") {
  const setCaptions = (visibility) =>
    page.evaluate((visibility) => {
      for (const node of document.querySelectorAll(".caption, .tools, .now, .tip, .badge, .busy, .problem")) node.style.visibility = visibility;
    }, visibility);
  await setCaptions("hidden");
  await waitForFrames(page);
  const png = await page.locator(selector).screenshot({ timeout: TIMEOUT_MS });
  await setCaptions("");
  const { data, info } = await sharp(png).ensureAlpha().raw().toBuffer({ resolveWithObject: true });
  return { width: info.width, height: info.height, data };
}

/** Waits until pending changes are drawn, including the full-resolution frame that follows a movement. */
export const waitForFrames = (page) =>
  page.evaluate(async () => {
    const roots = [document, ...[...document.querySelectorAll("molmesh-viewer")].map((viewer) => viewer.shadowRoot ?? viewer)];
    const canvases = roots.flatMap((root) => [...root.querySelectorAll("canvas")]);
    const isCoarse = ({ width, clientWidth }) => width < Math.floor(clientWidth * Math.min(devicePixelRatio, 2));
    // A turning surface may stay at a lower resolution.
    const end = performance.now() + 600;
    for (let i = 0; i < 3 || (canvases.some(isCoarse) && performance.now() < end); i += 1) await new Promise((resolve) => requestAnimationFrame(resolve));
  });

/** Returns a picture after two in a row are equal, because earlier changes may still have to be drawn. */
export async function stablePicture(page, selector) {
  const end = performance.now() + TIMEOUT_MS;
  for (let last = await picture(page, selector); ; ) {
    const next = await picture(page, selector);
    if (next.data.equals(last.data)) return next;
    assert.ok(performance.now() < end, "the picture keeps changing");
    last = next;
  }
}

const luminance = (data, i) => (0.2126 * data[i] + 0.7152 * data[i + 1] + 0.0722 * data[i + 2]) / 255;

/** Returns size and brightness of the part of a picture that differs from the background. */
export function silhouette({ width, height, data }) {
  const same = (i, j) => [0, 1, 2].every((c) => Math.abs(data[i + c] - data[j + c]) <= 6);
  let [pixels, sum] = [0, 0];
  const rows = Array.from({ length: height }, () => 0);
  for (let y = 0; y < height; y += 1) {
    // The background may have a vertical gradient, so each row is compared with its own edge.
    const edge = 4 * (y * width + 2);
    for (let x = 2; x < width - 2; x += 1) {
      const i = 4 * (y * width + x);
      if (same(i, edge)) continue;
      pixels += 1;
      rows[y] += 1;
      sum += luminance(data, i);
    }
  }
  return { pixels, share: pixels / (width * height), brightness: pixels ? sum / pixels : 0, background: luminance(data, 4 * 2) };
}

/** Returns the mask of the surface in a picture: true for pixels that differ from the background, without a frame. */
export function maskOf({ width, height, data }) {
  const frame = 16;
  const differs = (i, j) => [0, 1, 2].some((c) => Math.abs(data[i + c] - data[j + c]) > 6);
  const isInside = (x, y) => Math.min(x, y, width - 1 - x, height - 1 - y) >= frame;
  const background = 4 * (frame * width + frame);
  return Array.from({ length: width * height }, (_, i) => isInside(i % width, Math.floor(i / width)) && differs(4 * i, background));
}

/** Returns the silhouette as 48 × 48 cells of its bounding box: silhouettes of other sizes have the same cells. */
function cellsOf(picture) {
  const n = 48;
  const mask = maskOf(picture);
  const points = mask.flatMap((set, i) => (set ? [[i % picture.width, Math.floor(i / picture.width)]] : []));
  assert.ok(points.length > 1000, "the picture is empty");
  const [low, high] = [Math.min, Math.max].map((end) => [0, 1].map((k) => points.reduce((found, p) => end(found, p[k]), points[0][k])));
  const at = (t, k) => Math.round(low[k] + ((t + 0.5) / n) * (high[k] - low[k]));
  return Array.from({ length: n * n }, (_, i) => mask[at(Math.floor(i / n), 1) * picture.width + at(i % n, 0)]);
}

/** Returns the share of the cells of two silhouettes that belong to one of them only. */
export function difference(a, b) {
  const [one, other] = [cellsOf(a), cellsOf(b)];
  const count = (holds) => one.filter((set, i) => holds(set, other[i])).length;
  return count((x, y) => x !== y) / count((x, y) => x || y);
}

/** Reads JSON, bounds and sizes of a GLB without a library. */
export function glb(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  assert.equal(view.getUint32(0, true), 0x46546c67, "not a GLB");
  const length = view.getUint32(12, true);
  const json = JSON.parse(Buffer.from(bytes.buffer, bytes.byteOffset + 20, length).toString());
  const primitive = json.meshes[0].primitives[0];
  const positions = json.accessors[primitive.attributes.POSITION];
  return { json, start: 28 + length, primitive, indices: json.accessors[primitive.indices], min: positions.min, max: positions.max, vertices: positions.count };
}

/** Returns a copy of a GLB after `change` has edited its array of indices. */
export function withIndices(bytes, change) {
  const copy = Buffer.from(bytes);
  const { json, start, indices } = glb(copy);
  const view = json.bufferViews[indices.bufferView];
  const Type = { 5121: Uint8Array, 5123: Uint16Array, 5125: Uint32Array }[indices.componentType];
  const raw = new Uint8Array(view.byteLength).map((_, i) => copy[start + (view.byteOffset ?? 0) + i]);
  const array = new Type(raw.buffer);
  change(array);
  raw.forEach((byte, i) => (copy[start + (view.byteOffset ?? 0) + i] = byte));
  return copy;
}

/** Returns the address of the same mesh without compression, which the functions here read and change. */
export const uncompressed = (address) => address.replace("compress=meshopt", "compress=none");

/** Fetches the mesh that the page requests, without compression. */
export const fetchUncompressed = (route) => route.fetch({ url: uncompressed(route.request().url()) });

/** Reverses the winding of every triangle. */
export const inverted = (bytes) =>
  withIndices(bytes, (array) => {
    for (let i = 0; i < array.length; i += 3) [array[i], array[i + 1]] = [array[i + 1], array[i]];
  });

/** Makes every triangle degenerate. */
export const degenerate = (bytes) => withIndices(bytes, (array) => array.fill(0));

/** Compares a picture of the whole surface with the report of its GLB. Returns the fault, or null. */
export function pictureFault(picture, bytes, plain) {
  const { min, max, json } = glb(bytes);
  const { area, volume } = json.asset.extras;
  const radius = Math.hypot(...max.map((v, i) => v - min[i])) / 2;
  // The camera of the viewer in its initial view.
  const aspect = Math.min(1, picture.width / picture.height);
  const distance = (0.8 * radius) / Math.sin((14 * Math.PI) / 180) / aspect;
  const scale = picture.height / (2 * distance * Math.tan((14 * Math.PI) / 180));
  const { pixels, brightness } = silhouette(picture);
  const shadow = pixels / scale ** 2;
  // A ball has the smallest shadow of all bodies of one volume; a closed surface has at most half its area as shadow.
  const ball = Math.PI * ((3 * volume) / (4 * Math.PI)) ** (2 / 3);
  if (shadow < 0.8 * ball) return `the silhouette has ${shadow.toFixed(0)} Å², a ball of this volume ${ball.toFixed(0)} Å²`;
  if (shadow > 0.5 * area) return `the silhouette has ${shadow.toFixed(0)} Å², the surface ${area.toFixed(0)} Å²`;
  // The lights move with the camera: outer sides that face it are bright, inner sides are dark.
  if (brightness < 0.85 * plain) return `the surface is dark (${brightness.toFixed(3)}), as if seen from inside; its colour has ${plain.toFixed(3)}`;
  return null;
}

/** Returns the luminance of the default surface colour. */
export const plainColor = (page) =>
  page.evaluate(() => {
    const hex = getComputedStyle(document.documentElement).getPropertyValue("--plain").trim();
    const [r, g, b] = [1, 3, 5].map((at) => Number.parseInt(hex.slice(at, at + 2), 16) / 255);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  });

/** Returns the serious and critical findings of axe. */
export async function axe(page) {
  const source = readFileSync(require.resolve("axe-core/axe.min.js"), "utf8");
  // Playwright runs scripts in the page regardless of its content security policy.
  await page.evaluate(source);
  const { violations } = await page.evaluate(() => window.axe.run(document, { resultTypes: ["violations"] }));
  const serious = violations.filter(({ impact }) => ["serious", "critical"].includes(impact));
  return serious.map(({ id, nodes }) => `${id}: ${nodes.map((n) => `${n.target} ${n.failureSummary}`).join("; ")}`);
}

/** Returns a promise and the function that resolves it. */
export function deferred() {
  let resolve;
  const promise = new Promise((done) => (resolve = done));
  return { promise, resolve };
}

export const sample = (name) => path.join(ROOT, "samples", name);

/** Fetches an address of the service without the browser. */
export async function fetchBytes(address, options) {
  const reply = await fetch(SERVICE_URL + address, options);
  return { status: reply.status, headers: reply.headers, bytes: Buffer.from(await reply.arrayBuffer()) };
}

export { assert };
