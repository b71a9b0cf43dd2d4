// After requests that fail, are cancelled or are superseded, the page still shows and describes the previous surface.
import { readFileSync } from "node:fs";
import {
  assert, assertClean, axe, browser, deferred, drop, fetchBytes, meshesShown, open, run, sample, stablePicture, start,
  waitForMesh, SERVICE_URL, TIMEOUT_MS,
} from "./lib.mjs";
import { packed } from "./meshopt.mjs";

const chromium = await browser();
// Small, because surfaces are compared by their pictures.
const viewport = { width: 640, height: 480 };
const page = await start(chromium, { viewport });
const problem = page.locator("#problem");
const entry = /\/v1\/pdb\/1crn\/surface\.glb/;
const rejection = { status: 503, contentType: "application/problem+json", body: JSON.stringify({ type: "/problems/queue-full", title: "The queue is full", status: 503, detail: "try later" }) };

/** Returns all text of the page that names or describes the surface. */
const described = (p) =>
  p.evaluate(() => ({
    name: document.querySelector("#structure-name").textContent,
    subtitle: document.querySelector("#structure-title").textContent,
    title: document.title,
    address: location.pathname + location.search,
    curl: document.querySelector("#curl").textContent,
    report: document.querySelector("#report table").textContent,
    now: document.querySelector("#now").textContent,
    set: [...document.querySelectorAll(".field.is-set")].map((field) => field.dataset.parameter),
    chains: document.querySelector("#p-chains").value,
    hint: document.querySelector("#p-chains").placeholder,
    preview: !document.querySelector("#preview").hidden,
    colours: ["#colour", "#palette", "#single-colour"].map((id) => document.querySelector(id).value),
    legend: document.querySelector("#legend").textContent,
    byChain: document.querySelector("#by-chain").checked,
    sticks: document.querySelector("#sticks").checked,
  }));

const set = async (p, name, value) => {
  await p.locator(`#p-${name}`).fill(value);
  await p.locator(`#p-${name}`).press("Enter");
};
/** Chooses a colour scheme. */
const choose = (scheme) => page.locator("#colour").selectOption(scheme);
/** Chooses a colour scheme, and waits until the legend names it. */
const recolour = async (scheme, legend) => {
  await choose(scheme);
  await page.locator("#legend", { hasText: legend }).waitFor();
};
/** Downloads the shown surface. */
const downloaded = async (format) => {
  const [download] = await Promise.all([page.waitForEvent("download"), page.locator(`#formats button[data-format="${format}"]`).click()]);
  return readFileSync(await download.path());
};
const fetchEntry = async (p, id) => {
  await p.locator("#pdb").fill(id);
  await p.locator("#pdb").press("Enter");
};

/** Runs `act` and checks that page and surface are the same as before. */
async function unchanged(p, act) {
  await p.mouse.move(1, 1);
  const before = { ...(await described(p)), surfaces: await meshesShown(p) };
  const previous = await stablePicture(p);
  await act();
  // Time to show a surface by mistake.
  await p.waitForTimeout(400);
  assert.deepEqual({ ...(await described(p)), surfaces: await meshesShown(p) }, before);
  // Dithering changes the background by up to 8.
  const now = await stablePicture(p);
  assert.ok(now.data.every((v, i) => Math.abs(v - previous.data[i]) <= 8), "another surface is shown");
  assert.ok(await p.locator("#busy").isHidden(), "the page still waits");
}

/** Delays responses until `release` is called. `requested` resolves at the first request. */
async function hold(p, pattern) {
  const [requested, released] = [deferred(), deferred()];
  await p.route(pattern, async (route) => {
    requested.resolve();
    await released.promise;
    await route.continue().catch(() => undefined);
  });
  return { requested: requested.promise, release: async () => { released.resolve(); await p.unroute(pattern); } };
}

await run({
  "a structure that cannot be loaded leaves the previous one": async () => {
    await waitForMesh(page, () => set(page, "chains", "A"));
    assert.match((await described(page)).address, /chains=A/);
    await unchanged(page, async () => {
      await fetchEntry(page, "9xyz");
      await problem.locator("strong").waitFor();
      assert.match(await problem.textContent(), /^9XYZ: The archive has no such entry.*still that of 4PTI/s);
    });
    await unchanged(page, async () => {
      await drop(page, "poem.txt", Buffer.from("Whose woods these are I think I know"));
      await problem.locator("strong", { hasText: "poem.txt" }).waitFor();
      assert.match(await problem.textContent(), /The structure cannot be read.*still that of 4PTI/s);
    });
    // A rejection by the service, and a response that is not a mesh.
    for (const [response, expected] of [[rejection, /^1CRN: The queue is full/], [{ status: 200, contentType: "model/gltf-binary", body: "glTF?" }, /^1CRN: .*no GLB/]]) {
      await page.route(entry, (route) => route.fulfill(response));
      await unchanged(page, async () => {
        await fetchEntry(page, "1crn");
        await problem.locator("strong", { hasText: "1CRN" }).waitFor();
        assert.match(await problem.textContent(), expected);
      });
      await page.unroute(entry);
    }
    // Downloads also belong to the displayed surface.
    const [download] = await Promise.all([page.waitForEvent("download"), page.locator('#formats button[data-format="stl"]').click()]);
    assert.equal(download.suggestedFilename(), "4PTI.stl");
    await page.getByRole("button", { name: "Close" }).click();
  },

  "nothing changes before the mesh arrives, or if the request is cancelled": async () => {
    const mesh = await hold(page, entry);
    await unchanged(page, async () => {
      const before = await described(page);
      await fetchEntry(page, "1crn");
      await mesh.requested;
      await page.locator("#busy").waitFor();
      const { set: _, chains: __, ...during } = await described(page);
      assert.deepEqual({ ...during, set: before.set, chains: before.chains }, before);
      await page.locator("#cancel").click();
      await mesh.release();
    });
    const upload = await hold(page, /\/v1\/structures$/);
    await unchanged(page, async () => {
      await drop(page, "1crn.cif", readFileSync(sample("1crn.cif")));
      await upload.requested;
      await page.locator("#busy").waitFor();
      await page.locator("#cancel").click();
      await upload.release();
    });
  },

  "another structure resets the parameters that name chains, models and locations": async () => {
    await waitForMesh(page, () => set(page, "isovalue", "0.6"));
    await page.locator("#parameters details.more").evaluate((node) => (node.open = true));
    await waitForMesh(page, () => set(page, "model", "1"));
    // The sample has no alternative locations.
    await page.route(/&altloc=A/, (route) => route.continue({ url: route.request().url().replace("&altloc=A", "") }));
    await waitForMesh(page, () => set(page, "altloc", "A"));
    await waitForMesh(page, () => fetchEntry(page, "1crn"));
    const now = await described(page);
    assert.deepEqual([now.name, now.address, now.set], ["1CRN", "/?pdb=1crn&isovalue=0.6", ["isovalue"]]);
    assert.equal(now.title, "1CRN · molmesh");
    assert.match(now.curl, /\/v1\/pdb\/1crn\/surface\.glb\?isovalue=0\.6'? -o 1crn\.glb$/);
    const { headers } = await fetchBytes("/v1/pdb/1crn/surface.glb?isovalue=0.6");
    assert.ok(now.now.startsWith(`${Number(headers.get("molmesh-triangles")).toLocaleString("en")} triangles`), now.now);
  },

  "back and forward load the structure of the address or explain the failure": async () => {
    const other = { name: "4PTI", address: "/?isovalue=0.6&model=1&chains=A&altloc=A" };
    const addressed = async () => (({ name, address }) => ({ name, address: [...new URLSearchParams(address.slice(2))].sort().join() }))(await described(page));
    const expected = { name: other.name, address: [...new URLSearchParams(other.address.slice(2))].sort().join() };
    await waitForMesh(page, () => page.goBack());
    assert.deepEqual(await addressed(), expected);
    assert.equal((await described(page)).chains, "A");
    await page.route(entry, (route) => route.fulfill(rejection));
    await unchanged(page, async () => {
      await page.goForward();
      await problem.locator("strong", { hasText: "1CRN" }).waitFor();
    });
    await page.unroute(entry);
    // The failed request can be repeated.
    await waitForMesh(page, () => page.getByRole("button", { name: "Try again" }).click());
    assert.deepEqual((({ name, address }) => [name, address])(await described(page)), ["1CRN", "/?pdb=1crn&isovalue=0.6"]);
    await waitForMesh(page, () => page.locator("#reset-all").click());
  },

  "a rejected parameter is reset": async () => {
    await unchanged(page, async () => {
      await set(page, "resolution", "0.07");
      await problem.locator("strong").waitFor();
      assert.match(await problem.textContent(), /^1CRN: The grid would be too large.*limit.*as they were before/s);
      assert.deepEqual(await axe(page), []);
    });
    assert.equal(await page.locator("#p-resolution").inputValue(), "");
    await waitForMesh(page, () => problem.getByRole("button", { name: /^Use [\d.]+ Å$/ }).click());
    assert.match((await described(page)).address, /resolution=/);
    await waitForMesh(page, () => page.locator("#reset-all").click());
  },

  "a preview disappears if its mesh fails": async () => {
    // Sliders show previews only if meshes are slow.
    let isRejecting = false;
    await page.route(entry, async (route) => {
      const isPreview = route.request().url().includes("resolution=");
      if (isRejecting && !isPreview) return route.fulfill(rejection);
      await new Promise((resolve) => setTimeout(resolve, 400));
      await route.continue().catch(() => undefined);
    });
    await waitForMesh(page, () => set(page, "isovalue", "0.7"));
    isRejecting = true;
    await unchanged(page, async () => {
      const drag = (types) =>
        page.evaluate((types) => {
          const slider = document.querySelector('[data-slider="isovalue"]');
          slider.value = "200";
          for (const type of types) slider.dispatchEvent(new Event(type, { bubbles: true }));
        }, types);
      await drag(["pointerdown", "input"]);
      await page.locator("#preview").waitFor();
      await drag(["pointerup", "change"]);
      await problem.locator("strong", { hasText: "1CRN" }).waitFor();
    });
    await page.unroute(entry);
    await page.getByRole("button", { name: "Close" }).click();
    await waitForMesh(page, () => page.locator("#reset-all").click());
  },

  "colours that are refused, cancelled or cannot be fetched leave the previous ones": async () => {
    await waitForMesh(page, () => page.locator("#by-chain").check());
    await recolour("bfactor", /\d/);
    const [low, high] = [page.locator("#legend .low"), page.locator("#legend .high")];
    const shown = await described(page);
    const file = await downloaded("glb");
    assert.ok(file.equals((await fetchBytes("/v1/pdb/1crn/surface.glb?color=bfactor&split=chain")).bytes));
    // Parts are chains or pockets, not both.
    await unchanged(page, async () => {
      await choose("pocket");
      await problem.locator("strong", { hasText: "1CRN: " }).waitFor();
    });
    await unchanged(page, async () => {
      await set(page, "color_range", "5,1");
      await problem.locator("p", { hasText: "the lower one first" }).waitFor();
    });
    const colors = /\/v1\/pdb\/1crn\/colors/;
    const held = await hold(page, colors);
    await unchanged(page, async () => {
      await choose("element");
      await held.requested;
      await page.locator("#busy").waitFor();
      await page.locator("#cancel").click();
      await held.release();
    });
    assert.ok(await problem.isHidden());
    // A server that ends during a request.
    for (const [pattern, act] of [[colors, () => choose("element")], [entry, () => set(page, "isovalue", "0.8")]]) {
      await page.route(pattern, (route) => route.abort("connectionreset"));
      await unchanged(page, async () => {
        await act();
        await problem.locator("strong", { hasText: "cannot be reached" }).waitFor();
      });
      await page.unroute(pattern);
    }
    assert.deepEqual(await described(page), shown);
    assert.ok(file.equals(await downloaded("glb")));
    // The next success removes the error, and every description follows.
    await set(page, "color_range", "5,15");
    await page.locator("#legend", { hasText: /^5\s*15$/ }).waitFor();
    assert.ok(await problem.isHidden());
    assert.deepEqual([await low.textContent(), await high.textContent()], ["5", "15"]);
    const { address, curl } = await described(page);
    assert.ok(address.includes("color_range=5,15") && curl.includes("color_range=5,15"), `${address} ${curl}`);
    assert.ok(!file.equals(await downloaded("glb")));
    // Without a scheme, the service refuses a range.
    await choose("none");
    await page.waitForFunction(() => !location.search.includes("color"));
    await unchanged(page, async () => {
      await set(page, "color_range", "1,5");
      await problem.locator("p", { hasText: "color_range" }).waitFor();
    });
    await waitForMesh(page, () => page.locator("#reset-all").click());
  },

  "values that need each other are requested together": async () => {
    const requests = () => page.requests.filter((line) => entry.test(line)).length;
    const before = requests();
    const { address } = await described(page);
    await set(page, "paper_a", "2");
    await page.getByText("Also set paper_b").waitFor();
    assert.equal(await page.locator("#p-paper_a").inputValue(), "2");
    assert.deepEqual([requests(), (await described(page)).address], [before, address]);
    await waitForMesh(page, () => set(page, "paper_b", "1000"));
    assert.ok(await page.locator("#missing").isHidden());
    const now = await described(page);
    assert.deepEqual([now.address, now.set], [`${address}&paper_a=2&paper_b=1000`, ["paper_a", "paper_b"]]);
    assert.ok(now.curl.includes("paper_a=2&paper_b=1000"), now.curl);
    await waitForMesh(page, () => page.locator("#reset-all").click());
  },

  "a late mesh does not replace a newer one": async () => {
    // A packed mesh waits for its decoder; meanwhile a plain mesh is requested and shown.
    const other = await start(chromium, {
      viewport,
      url: `${SERVICE_URL}/?compress=none`,
      before: (p) => p.route(entry, async (route) => {
        const reply = await route.fetch();
        await route.fulfill({ response: reply, body: await packed(await reply.body()) });
      }),
    });
    const decoder = await hold(other, /\/assets\/meshopt/);
    await fetchEntry(other, "1crn");
    await decoder.requested;
    await other.locator("#sample").click();
    await other.locator("#busy").waitFor({ state: "hidden" });
    await unchanged(other, () => decoder.release());
    assert.equal((await described(other)).name, "4PTI");
    assertClean(other);
    await other.context().close();
  },

  "an upload with the name of the sample is not the sample": async () => {
    await waitForMesh(page, () => drop(page, "sample.pdb", readFileSync(sample("1crn.cif"))));
    const { address, curl } = await described(page);
    assert.match(address, /structure=[0-9a-f]{64}/);
    assert.ok(!curl.includes("/sample.pdb"), curl);
    await page.reload({ timeout: TIMEOUT_MS });
    await page.waitForFunction(() => window.measures.length > 0, null, { timeout: TIMEOUT_MS });
    assert.equal((await described(page)).name, "1CRN");
  },

  "a hostile title or file name is shown as text": async () => {
    const attack = '<img src=x onerror="window.hit=1">';
    const atoms = readFileSync(sample("4pti.pdb"), "latin1").replace(/^TITLE.*\n/gm, "");
    await waitForMesh(page, () => drop(page, `${attack}.pdb`, Buffer.from(`TITLE     ${attack} \u001b[31m\n${atoms}`, "latin1")));
    const now = await described(page);
    assert.ok(now.subtitle.includes(attack) && !now.subtitle.includes("\u001b"), now.subtitle);
    assert.equal(await page.locator("img[src=x]").count(), 0);
    assert.equal(await page.evaluate(() => window.hit), undefined);
    assert.ok(now.title.endsWith("molmesh"), now.title);
  },

  "a structure that the service has removed is uploaded again once": async () => {
    const removed = { status: 404, contentType: "application/problem+json", body: JSON.stringify({ type: "/problems/no-such-structure", title: "There is no such structure", status: 404 }) };
    await waitForMesh(page, () => drop(page, "1crn.cif", readFileSync(sample("1crn.cif"))));
    const uploads = () => page.requests.filter((line) => line.startsWith("POST")).length;
    const before = uploads();
    let failures = Infinity;
    await page.route(/\/v1\/structures\/[0-9a-f]+\/surface\.glb/, (route) => (failures-- > 0 ? route.fulfill(removed) : route.continue()));
    await unchanged(page, async () => {
      await set(page, "isovalue", "0.9");
      await problem.locator("strong", { hasText: "1CRN: There is no such structure" }).waitFor();
    });
    assert.equal(uploads(), before + 1);
    failures = 1;
    await waitForMesh(page, () => set(page, "chains", "A"));
    assert.equal(uploads(), before + 2);
    assert.deepEqual((await described(page)).set, ["chains"]);
    await page.unroute(/\/v1\/structures\/[0-9a-f]+\/surface\.glb/);
  },

  "without a previous surface a rejected parameter can be corrected": async () => {
    const other = await open(chromium, { viewport, url: `${SERVICE_URL}/?pdb=1crn&resolution=0.07` });
    const rejected = other.locator("#problem");
    await rejected.locator("strong", { hasText: "1CRN: The grid would be too large" }).waitFor();
    assert.ok(!/still|as they were/.test(await rejected.textContent()));
    assert.equal(await other.locator("#structure-name").textContent(), "No surface");
    assert.equal(await other.locator("#p-resolution").inputValue(), "0.07");
    await waitForMesh(other, () => rejected.getByRole("button", { name: /^Use [\d.]+ Å$/ }).click());
    const now = await described(other);
    assert.equal(now.name, "1CRN");
    assert.match(now.address, /^\/\?pdb=1crn&resolution=/);
    assertClean(other, /Failed to load resource/);
    await other.context().close();
  },

  "after a failed first request, the sample is offered and no control is in vain": async () => {
    const other = await open(chromium, { viewport, url: `${SERVICE_URL}/?pdb=9xyz` });
    await other.locator("#problem strong", { hasText: "9XYZ: The archive has no such entry" }).waitFor();
    const controls = "#formats button, #copy-curl, #copy-url, #turn, #home, #colour, #sticks, #by-chain, #transparency, #find-form button[type=submit]";
    const disabled = () => other.locator(controls).evaluateAll((nodes) => nodes.map((node) => node.matches(":disabled")));
    assert.ok((await disabled()).length > 15 && !(await disabled()).includes(false), `${await disabled()}`);
    await waitForMesh(other, () => other.getByRole("button", { name: "Show the sample" }).click());
    await other.waitForFunction(() => !document.querySelector("#colour").disabled);
    assert.ok(!(await disabled()).includes(true), `${await disabled()}`);
    assert.ok(await other.locator("#problem").isHidden());
    const { name, address } = await described(other);
    assert.deepEqual([name, address], ["4PTI", "/"]);
    assertClean(other, /Failed to load resource/);
    await other.context().close();
  },

  "the page has no other errors": async () => {
    // The browser logs rejected requests.
    assertClean(page, /Failed to load resource/);
  },
});
