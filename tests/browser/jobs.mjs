// A service that promises what takes longer than an instant: progress is shown, and what is superseded is dismissed.
import { assert, browser, clean, open, reported, run, shown, PATIENCE } from "./lib.mjs";

const chromium = await browser();
const page = await open(chromium);
const jobs = () => page.asked.filter((line) => line.includes("/v1/jobs/"));

await run({
  "a promised mesh is followed by its events and shown": async () => {
    await page.waitForFunction(() => window.seen.length > 0, null, { timeout: PATIENCE });
    await page.locator("#p-resolution").fill("0.2");
    const before = await shown(page);
    await page.locator("#p-resolution").press("Enter");
    await page.waitForFunction((n) => window.seen.length > n, before, { timeout: PATIENCE });
    assert.equal(await reported(page, "resolution"), 0.2);
    for (const part of ["/events", "/result"]) assert.ok(jobs().some((line) => line.endsWith(part)), `${jobs()}`);
  },

  "progress is shown, and a superseded job is dismissed": async () => {
    // Its events are held back: to the page it goes on and on.
    const document = { status: "running", fraction: 0.4, stage: "field", problem: null };
    let first;
    await page.route("**/events", (route) => {
      const id = /jobs\/([0-9a-f]+)\//.exec(route.request().url())[1];
      first ??= id;
      if (id !== first) return route.continue();
      return route.fulfill({ contentType: "text/event-stream", body: `id: 1\nevent: running\ndata: ${JSON.stringify({ ...document, jobID: id })}\n\n` });
    });
    await page.locator("#p-resolution").fill("0.22");
    await page.locator("#p-resolution").press("Enter");
    await page.locator("#busy").waitFor();
    await page.waitForFunction(() => /field, 40 %/.test(document.querySelector("#busy-text").textContent), null, { timeout: PATIENCE });
    assert.equal(await page.locator("#progress").getAttribute("value"), "0.4");
    const before = await shown(page);
    await page.locator("#p-resolution").fill("0.6");
    await page.locator("#p-resolution").press("Enter");
    await page.waitForFunction((n) => window.seen.length > n, before, { timeout: PATIENCE });
    assert.equal(await reported(page, "resolution"), 0.6);
    assert.ok(jobs().some((line) => line.startsWith("DELETE") && line.includes(first)), `${jobs()}`);
    assert.ok(await page.locator("#busy").isHidden());
  },

  "nothing went wrong": async () => {
    // The job may have ended before it was dismissed (409), and the page leaves events behind.
    clean(page, /409 \(Conflict\)/, /ERR_ABORTED/);
  },
});
