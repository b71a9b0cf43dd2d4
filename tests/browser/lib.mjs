// What the browser tests have in common: a browser, pages that are watched, pictures that are looked at.
//
// The environment says where things are: MOLMESH_URL (a running service), MOLMESH_MODULES (node_modules of the tests),
// MOLMESH_CHROMIUM (the browser), MOLMESH_ROOT (the repository).
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import path from "node:path";

const { MOLMESH_URL, MOLMESH_MODULES, MOLMESH_CHROMIUM, MOLMESH_ROOT } = process.env;
export const URL_OF_SERVICE = MOLMESH_URL;
export const MODULES = MOLMESH_MODULES;
export const ROOT = MOLMESH_ROOT;
export const require = createRequire(path.join(MODULES, "x.js"));
export const { chromium } = require("playwright-core");
/** Longer than anything takes on a machine that does ten other things. */
export const PATIENCE = 180_000;

/** A browser that finds nothing but this machine. Surfaces are drawn by the processor. */
export async function browser(...flags) {
  const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1", ...flags];
  return chromium.launch({ executablePath: MOLMESH_CHROMIUM, args, timeout: PATIENCE });
}

/** A page in a context of its own, watched: what it asks for, and what goes wrong in it. */
export async function open(browser, options = {}) {
  const { url = URL_OF_SERVICE + "/", before, ...rest } = options;
  const context = await browser.newContext({ viewport: { width: 1280, height: 800 }, reducedMotion: "reduce", acceptDownloads: true, ...rest });
  context.setDefaultTimeout(PATIENCE);
  const page = await context.newPage();
  page.wrong = [];
  page.asked = [];
  page.on("console", (message) => ["error", "warning"].includes(message.type()) && page.wrong.push(`${message.type()}: ${message.text()}`));
  page.on("pageerror", (error) => page.wrong.push(`exception: ${error.message}`));
  page.on("request", (request) => page.asked.push(`${request.method()} ${request.url()}`));
  await page.addInitScript(() => {
    window.seen = [];
    new PerformanceObserver((list) => window.seen.push(...list.getEntries().map((e) => ({ ms: e.duration, ...e.detail })))).observe({ type: "measure", buffered: true });
    document.addEventListener("securitypolicyviolation", (e) => console.error(`policy: ${e.violatedDirective} ${e.blockedURI}`));
  });
  await before?.(page);
  await page.goto(url, { timeout: PATIENCE });
  return page;
}

/** Surfaces that the page has shown so far. */
export const shown = (page) => page.evaluate(() => window.seen.filter((e) => e.preview === null).length);

/** Does something, and waits for the surface that follows. */
export async function remeshed(page, act) {
  const before = await shown(page);
  await act();
  await page.waitForFunction((n) => window.seen.filter((e) => e.preview === null).length > n, before, { timeout: PATIENCE });
}

/** Opens the page and waits for its first surface. */
export async function start(browser, options = {}) {
  const page = await open(browser, options);
  await page.waitForFunction(() => window.seen.length > 0, null, { timeout: PATIENCE });
  return page;
}

/** Puts a slider where its value is `value` of a thousand, as a hand or a key does. */
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

/** A number of the report that is shown. */
export async function reported(page, row) {
  const text = await page.locator(`#report tr[data-row="${row}"] td`).textContent();
  return Number(text.replaceAll(",", "").split(" ")[0]);
}

/** Fails if anything went wrong in a page, or anything but the service was asked. `allowed` are patterns of what may. */
export function clean(page, ...allowed) {
  const wrong = page.wrong.filter((line) => !allowed.some((pattern) => pattern.test(line)));
  assert.deepEqual(wrong, [], "something went wrong in the page");
  const elsewhere = page.asked.filter((line) => !line.includes(` ${new URL(page.url()).origin}/`) && !line.includes(" blob:"));
  assert.deepEqual(elsewhere, [], "the page asked elsewhere");
}

/** Runs scenarios one after the other; the first that fails ends the process with its name. */
export async function run(scenarios) {
  for (const [name, scenario] of Object.entries(scenarios)) {
    const begun = performance.now();
    try {
      await scenario();
      console.log(`ok ${name} (${((performance.now() - begun) / 1000).toFixed(1)} s)`);
    } catch (error) {
      console.log(`FAILED ${name}`);
      console.log(error.stack);
      process.exit(1);
    }
  }
  process.exit(0);
}

/** Takes the words off the surface, and its picture: width, height and RGBA bytes. */
export async function picture(page, selector = "#view-home") {
  const words = (visibility) =>
    page.evaluate((visibility) => {
      for (const node of document.querySelectorAll(".caption, .tools, .now, .tip, .badge, .busy, .problem")) node.style.visibility = visibility;
    }, visibility);
  await words("hidden");
  await settled(page);
  const png = await page.locator(selector).screenshot({ timeout: PATIENCE });
  await words("");
  const helper = await page.context().browser().newPage();
  const decoded = await helper.evaluate(async (text) => {
    const bitmap = await createImageBitmap(await (await fetch(`data:image/png;base64,${text}`)).blob());
    const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
    const context = canvas.getContext("2d");
    context.drawImage(bitmap, 0, 0);
    const { data } = context.getImageData(0, 0, bitmap.width, bitmap.height);
    let text64 = "";
    for (let i = 0; i < data.length; i += 0x8000) text64 += String.fromCharCode(...data.subarray(i, i + 0x8000));
    return { width: bitmap.width, height: bitmap.height, data: btoa(text64) };
  }, png.toString("base64"));
  await helper.close();
  return { width: decoded.width, height: decoded.height, data: Buffer.from(decoded.data, "base64") };
}

/** Waits until what was asked for has been drawn, and a sharp picture stands still. */
export const settled = (page) =>
  page.evaluate(async () => {
    await new Promise((resolve) => setTimeout(resolve, 400));
    for (let i = 0; i < 3; i += 1) await new Promise((resolve) => requestAnimationFrame(resolve));
  });

/** Waits until two pictures are the same, and returns them: what was begun before may still have to be drawn. */
export async function still(page) {
  const end = performance.now() + PATIENCE;
  for (let last = await picture(page); ; ) {
    const next = await picture(page);
    if (next.data.equals(last.data)) return next;
    assert.ok(performance.now() < end, "it goes on moving");
    last = next;
  }
}

const luminance = (data, i) => (0.2126 * data[i] + 0.7152 * data[i + 1] + 0.0722 * data[i + 2]) / 255;

/** The part of a picture that is not its background, and how bright it is. */
export function silhouette({ width, height, data }) {
  const same = (i, j) => [0, 1, 2].every((c) => Math.abs(data[i + c] - data[j + c]) <= 6);
  let [pixels, sum] = [0, 0];
  const rows = Array.from({ length: height }, () => 0);
  for (let y = 0; y < height; y += 1) {
    // The background may fade towards the edges: it is that of the same row.
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

/** Triangles, bounds and sizes of a GLB, read without any library. */
export function glb(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  assert.equal(view.getUint32(0, true), 0x46546c67, "no GLB");
  const length = view.getUint32(12, true);
  const json = JSON.parse(Buffer.from(bytes.buffer, bytes.byteOffset + 20, length).toString());
  const primitive = json.meshes[0].primitives[0];
  const positions = json.accessors[primitive.attributes.POSITION];
  return { json, start: 28 + length, primitive, indices: json.accessors[primitive.indices], min: positions.min, max: positions.max, vertices: positions.count };
}

/** A GLB whose triangles are changed by `change(index array)`. */
export function doctored(bytes, change) {
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

/** Turns every triangle inside out. */
export const inverted = (bytes) =>
  doctored(bytes, (array) => {
    for (let i = 0; i < array.length; i += 3) [array[i], array[i + 1]] = [array[i + 1], array[i]];
  });

/** Leaves no triangle an area. */
export const emptied = (bytes) => doctored(bytes, (array) => array.fill(0));

/** Whether a picture of the whole shows the surface of the report, seen from outside: why not, or null. */
export function looksWrong(picture, bytes, plain) {
  const { min, max, json } = glb(bytes);
  const { area, volume } = json.asset.extras;
  const radius = Math.hypot(...max.map((v, i) => v - min[i])) / 2;
  // As the viewer looks at the whole.
  const aspect = Math.min(1, picture.width / picture.height);
  const distance = (0.8 * radius) / Math.sin((14 * Math.PI) / 180) / aspect;
  const scale = picture.height / (2 * distance * Math.tan((14 * Math.PI) / 180));
  const { pixels, brightness } = silhouette(picture);
  const seen = pixels / scale ** 2;
  // Nothing of this volume has a smaller shadow than a ball, and no closed surface a larger one than half its area.
  const ball = Math.PI * ((3 * volume) / (4 * Math.PI)) ** (2 / 3);
  if (seen < 0.8 * ball) return `its silhouette has ${seen.toFixed(0)} Å², a ball of its volume ${ball.toFixed(0)} Å²`;
  if (seen > 0.5 * area) return `its silhouette has ${seen.toFixed(0)} Å², its surface ${area.toFixed(0)} Å²`;
  // Lights go with the eye: what faces it is bright, the inside of what does not is dark.
  if (brightness < 0.85 * plain) return `it is as dark (${brightness.toFixed(3)}) as from inside; its colour is ${plain.toFixed(3)}`;
  return null;
}

/** How bright the colour of a surface is. */
export const plainColor = (page) =>
  page.evaluate(() => {
    const hex = getComputedStyle(document.documentElement).getPropertyValue("--plain").trim();
    const [r, g, b] = [1, 3, 5].map((at) => Number.parseInt(hex.slice(at, at + 2), 16) / 255);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  });

/** What axe finds that is serious or critical. */
export async function axe(page) {
  const source = readFileSync(require.resolve("axe-core/axe.min.js"), "utf8");
  // Playwright evaluates in the page whatever its policy says of scripts.
  await page.evaluate(source);
  const { violations } = await page.evaluate(() => window.axe.run(document, { resultTypes: ["violations"] }));
  const grave = violations.filter(({ impact }) => ["serious", "critical"].includes(impact));
  return grave.map(({ id, nodes }) => `${id}: ${nodes.map((n) => `${n.target} ${n.failureSummary}`).join("; ")}`);
}

export const sample = (name) => path.join(ROOT, "samples", name);

/** Fetches as a program would. */
export async function fetched(address, options) {
  const reply = await fetch(URL_OF_SERVICE + address, options);
  return { status: reply.status, headers: reply.headers, bytes: Buffer.from(await reply.arrayBuffer()) };
}

export { assert };
