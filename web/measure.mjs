// Measures the time from an input to the frame after the one that shows its effect, in a real browser, at full
// resolution and without previews: a move of the isovalue slider, which takes a new mesh, or with COLORS=1 a change of
// the colour scheme. Needs a running server and the test tools (make tools):
//
//   [COLORS=1] node web/measure.mjs FILE [SERVER] [RUNS]
//
// Prints per run: total ms, ms to the response head, to its last byte, to the frame. With COLORS=1: total ms, ms to the
// last byte of the colours, to apply them to the surface, to the frame. Then median and maximum.
import { createRequire } from "node:module";

const isColors = Boolean(process.env.COLORS);
const [file, server = "http://127.0.0.1:8080", runs = "25"] = process.argv.slice(2);
if (!file) throw new Error("usage: [COLORS=1] node web/measure.mjs FILE [SERVER] [RUNS]");
const require = createRequire(new URL("../target/test-tools/node/x.js", import.meta.url));
const { chromium } = require("playwright-core");
const executablePath = process.env.CHROMIUM ?? "/usr/bin/chromium";
const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"];
const browser = await chromium.launch({ executablePath, args: process.env.GPU ? ["--no-sandbox"] : args });
const page = await browser.newPage({ viewport: { width: 1280, height: 800 }, reducedMotion: "reduce" });
// Large structures take minutes without optimization.
page.setDefaultTimeout(300_000);
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
const median = (values) => [...values].sort((a, b) => a - b)[values.length >> 1];
// Schemes that every file has.
const schemes = ["element", "chain", "bfactor"];
await page.waitForFunction(() => !document.querySelector("#colour").disabled);
for (let run = 0; run < Number(runs); run += 1) {
  const slider = ['[data-slider="isovalue"]', String(480 + ((run * 37) % 61))];
  const [selector, value] = isColors ? ["#colour", schemes[run % 3]] : slider;
  const measure = await page.evaluate(([selector, value]) => {
    const before = window.measures.length;
    const control = document.querySelector(selector);
    control.value = value;
    // Like a key press: the value is set and final.
    for (const type of ["input", "change"]) control.dispatchEvent(new Event(type, { bubbles: true }));
    return new Promise((resolve) => {
      const check = () => (window.measures.length > before ? resolve(window.measures.at(-1)) : setTimeout(check, 5));
      check();
    });
  }, [selector, value]);
  const { ms, answered, received, applied, drawn, atoms, triangles } = measure;
  all.push(isColors ? applied : ms);
  const times = isColors ? [ms, received, applied, drawn] : [ms, answered, received, drawn];
  const size = isColors ? `${atoms} atoms` : `${triangles} triangles`;
  console.log(times.map((time) => time.toFixed(1).padStart(7)).join(" "), size);
  // Wait for work after the response: storing the result and fetching the report.
  await page.waitForTimeout(600);
}
const what = isColors ? "to apply the colours: " : "";
console.log(`${what}median ${median(all).toFixed(1)} ms, maximum ${Math.max(...all).toFixed(1)} ms`);
await browser.close();
