// Meshes that take longer than the wait of their request become jobs, with progress and cancellation.
import http from "node:http";
import { assert, assertClean, browser, fetchBytes, meshesShown, open, reportValue, run, SERVICE_URL, TIMEOUT_MS } from "./lib.mjs";

const chromium = await browser();
const page = await open(chromium);
const preferences = [];
/** Replaces the page's `Prefer: wait` by a wait of 0 s, so that every mesh becomes a job. */
const shorten = (page) =>
  page.route(/\/surface\.glb/, (route) => {
    const headers = route.request().headers();
    preferences.push(headers.prefer);
    return route.continue({ headers: headers.prefer ? { ...headers, prefer: "wait=0" } : headers });
  });
await shorten(page);
const jobs = () => page.requests.filter((line) => line.includes("/v1/jobs/"));

await run({
  "a job is followed by its events and its mesh is shown": async () => {
    await page.waitForFunction(() => window.measures.length > 0, null, { timeout: TIMEOUT_MS });
    await page.locator("#p-resolution").fill("0.2");
    const before = await meshesShown(page);
    await page.locator("#p-resolution").press("Enter");
    await page.waitForFunction((n) => window.measures.length > n, before, { timeout: TIMEOUT_MS });
    assert.equal(await reportValue(page, "resolution"), 0.2);
    assert.match(preferences.at(-1), /^wait=[1-9]/);
    for (const part of ["/events", "/result"]) assert.ok(jobs().some((line) => line.endsWith(part)), `${jobs()}`);
  },

  "progress is shown, and a superseded job is dismissed": async () => {
    // The first job appears to run forever: its events and its status are replaced.
    const document = { status: "running", fraction: 0.4, stage: "field", problem: null };
    let first;
    await page.route("**/events", (route) => {
      const id = /jobs\/([0-9a-f]+)\//.exec(route.request().url())[1];
      first ??= id;
      if (id !== first) return route.continue();
      return route.fulfill({ contentType: "text/event-stream", body: `id: 1\nevent: running\ndata: ${JSON.stringify({ ...document, jobID: id })}\n\n` });
    });
    await page.route(/\/v1\/jobs\/[0-9a-f]+\?wait=/, (route) => {
      const id = /jobs\/([0-9a-f]+)\?/.exec(route.request().url())[1];
      return id === first ? route.fulfill({ json: { ...document, jobID: id } }) : route.continue();
    });
    await page.locator("#p-resolution").fill("0.22");
    await page.locator("#p-resolution").press("Enter");
    await page.locator("#busy").waitFor();
    await page.waitForFunction(() => /field, 40 %/.test(document.querySelector("#busy-text").textContent), null, { timeout: TIMEOUT_MS });
    assert.equal(await page.locator("#progress").getAttribute("value"), "0.4");
    const before = await meshesShown(page);
    await page.locator("#p-resolution").fill("0.6");
    await page.locator("#p-resolution").press("Enter");
    await page.waitForFunction((n) => window.measures.length > n, before, { timeout: TIMEOUT_MS });
    assert.equal(await reportValue(page, "resolution"), 0.6);
    assert.ok(jobs().some((line) => line.startsWith("DELETE") && line.includes(first)), `${jobs()}`);
    assert.ok(await page.locator("#busy").isHidden());
  },

  "the component follows a job of another origin, and removing the element cancels it": async () => {
    const element = '<!doctype html><html lang="en"><title>component</title><molmesh-viewer style="height: 200px"></molmesh-viewer>';
    const server = http.createServer((_, reply) => reply.writeHead(200, { "content-type": "text/html" }).end(`${element}<script type="module" src="${SERVICE_URL}/molmesh-viewer.js"></script>`));
    await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
    const other = await open(chromium, { url: `http://127.0.0.1:${server.address().port}/` });
    await shorten(other);
    const load = (resolution, event) =>
      other.evaluate(([src, event]) => new Promise((resolve) => {
        const viewer = document.querySelector("molmesh-viewer");
        for (const name of [event, "molmesh-error"]) viewer.addEventListener(name, ({ detail }) => resolve(detail), { once: true });
        viewer.src = src;
      }), [`${SERVICE_URL}/v1/pdb/1crn/surface.glb?resolution=${resolution}`, event]);
    assert.equal((await load("0.17", "molmesh-load")).report?.resolution, 0.17);
    assert.ok(other.requests.some((line) => line.includes("/v1/jobs/") && line.endsWith("/result")), `${other.requests}`);
    // The job appears to run until it is cancelled, however soon it ends.
    const running = { status: "running", fraction: 0.4, stage: "field", problem: null };
    await other.route("**/events", (route) => route.fulfill({ contentType: "text/event-stream", body: `id: 1\nevent: running\ndata: ${JSON.stringify(running)}\n\n` }));
    await other.route(/\/v1\/jobs\/[0-9a-f]+\?wait=/, (route) => route.fulfill({ json: running }));
    assert.equal((await load("0.1", "molmesh-progress")).message, undefined);
    const id = other.requests.map((line) => /jobs\/([0-9a-f]+)/.exec(line)?.[1]).filter(Boolean).at(-1);
    const isCancellation = (request) => request.method() === "DELETE" && request.url() === `${SERVICE_URL}/v1/jobs/${id}`;
    // The removal alone cancels the job.
    assert.ok(!other.requests.includes(`DELETE ${SERVICE_URL}/v1/jobs/${id}`), `${other.requests}`);
    const answered = other.waitForResponse((reply) => isCancellation(reply.request()));
    await other.evaluate(() => document.querySelector("molmesh-viewer").remove());
    const answer = (await answered).status();
    const state = JSON.parse((await fetchBytes(`/v1/jobs/${id}?wait=55`)).bytes).status;
    // A job that has ended cannot be cancelled.
    assert.deepEqual([answer, state], answer === 409 ? [409, "successful"] : [200, "dismissed"]);
    // The browser logs the aborted event stream and a cancellation that came too late.
    assert.deepEqual(other.errors.filter((line) => !/ERR_ABORTED|409 \(Conflict\)/.test(line)), []);
    await other.context().close();
  },

  "the page has no errors": async () => {
    // The job may have ended before it was cancelled (409), and the page aborts event streams.
    assertClean(page, /409 \(Conflict\)/, /ERR_ABORTED/);
  },
});
