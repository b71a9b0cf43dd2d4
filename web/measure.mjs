// Measures the time from a slider input to the frame after the one that shows the new surface, in a real browser, at
// full resolution and without previews. Needs a running server and the test tools (make tools):
//
//   node web/measure.mjs FILE [SERVER] [RUNS]
//
// Prints per run: total ms, ms to the response head, to its last byte, to the frame. Then median and maximum.
import { createRequire } from "node:module";

const [file, server = "http://127.0.0.1:8080", runs = "25"] = process.argv.slice(2);
if (!file) throw new Error("usage: node web/measure.mjs FILE [SERVER] [RUNS]");
const require = createRequire(new URL("../target/test-tools/node/x.js", import.meta.url));
const { chromium } = require("playwright-core");
const executablePath = process.env.CHROMIUM ?? "/usr/bin/chromium";
const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"];
const browser = await chromium.launch({ executablePath, args: process.env.GPU ? ["--no-sandbox"] : args });
const page = await browser.newPage({ viewport: { width: 1280, height: 800 }, reducedMotion: "reduce" });
await page.addInitScript(() => {
  window.measures = [];
  new PerformanceObserver((list) => window.measures.push(...list.getEntries().map((e) => ({ ms: e.duration, ...e.detail })))).observe({ type: "measure", buffered: true });
});
await page.goto(server);
await page.waitForFunction(() => window.measures.length > 0);
await page.setInputFiles("#file", file);
await page.waitForFunction(() => window.measures.length > 1);
await page.waitForTimeout(1500);
console.log(`${await page.locator("#structure-name").textContent()}: ${await page.locator('[data-row="atoms"] td').textContent()} atoms, ${await page.locator('[data-row="resolution"] td').textContent()}`);
const all = [];
for (let run = 0; run < Number(runs); run += 1) {
  const position = 480 + ((run * 37) % 61);
  const measure = await page.evaluate((position) => {
    const before = window.measures.length;
    const slider = document.querySelector('[data-slider="isovalue"]');
    slider.value = String(position);
    // Like a key press: the value is set and final.
    for (const type of ["input", "change"]) slider.dispatchEvent(new Event(type, { bubbles: true }));
    return new Promise((resolve) => {
      const check = () => (window.measures.length > before ? resolve(window.measures.at(-1)) : setTimeout(check, 5));
      check();
    });
  }, position);
  all.push(measure.ms);
  console.log([measure.ms, measure.answered, measure.received, measure.drawn].map((ms) => ms.toFixed(1).padStart(7)).join(" "), measure.triangles, "triangles");
  // Wait for work after the response: storing the result and fetching the report.
  await page.waitForTimeout(600);
}
all.sort((a, b) => a - b);
console.log(`median ${all[all.length >> 1].toFixed(1)} ms, maximum ${all.at(-1).toFixed(1)} ms`);
await browser.close();
