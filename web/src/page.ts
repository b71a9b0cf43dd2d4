/** What the page does with structures, parameters and meshes. */

import type { Client } from "./api/client";
import type { Job } from "./api/jobs";
import { asProblem, Problem } from "./api/problem";
import type { Parameter } from "./api/schema";
import { entry, type Labels, labels, type Source, type Summary, upload } from "./api/structures";
import { Downloads } from "./downloads";
import { drops } from "./drop";
import { keyboard } from "./keyboard";
import { Picker } from "./picker";
import { type Delivery, Remesher, type Wish } from "./remesh";
import { curl, drawn, readAddress, SAMPLE, surface, writeAddress } from "./request";
import { Stage } from "./stage";
import { $, copy, el, number, show } from "./ui/dom";
import { Form } from "./ui/form";
import { problem as showProblem } from "./ui/problem";
import { report, timingsOf } from "./ui/report";

/** A mesh that takes longer than this, ms from the slider to the screen, is seen coarser while the slider is dragged. */
const PREVIEW_FROM = 200;

export class Page {
  readonly stage: Stage;
  private readonly remesher: Remesher;
  private readonly picker: Picker | null;
  private form: Form | null = null;
  private source: Source | null = null;
  private shown: { source: Source; resolution: number; took: number } | null = null;
  private opening: AbortController | null = null;
  private labelling: AbortController | null = null;
  private facts = 0;
  private busy = 0;

  constructor(private readonly client: Client) {
    this.stage = new Stage(client, (turning) => $("turn").setAttribute("aria-pressed", String(turning)));
    const { viewer } = this.stage;
    this.picker = viewer && new Picker(viewer, (words) => this.say(words));
    if (viewer && this.picker) keyboard($("view-home"), viewer, this.picker);
    for (const id of ["turn", "home", "colour"]) show($(id), viewer !== null);
    $("turn").addEventListener("click", () => viewer?.turn(!viewer.isTurning, true));
    $("home").addEventListener("click", () => viewer?.reset());
    this.remesher = new Remesher(client, {
      begin: (wish) => this.begin(wish),
      progress: (job) => this.progress(job),
      show: (delivery) => this.show(delivery),
      failed: (error, wish) => this.failed(error, wish),
      idle: () => this.idle(),
    });
    this.listen();
  }

  /** Builds what the description asks for, and opens what the address names, else the sample. */
  async start(parameters: Parameter[], formats: string[]): Promise<void> {
    this.form = new Form($("parameters"), $("picture-fields"), parameters, (mesh, live) => (mesh ? this.changed(live) : this.commands()));
    const asked = readAddress(this.form.names);
    this.form.fill(asked.choices);
    new Downloads(this.client, formats, (format) => this.source && { source: this.source, choices: this.choicesOf(format) }, (error) => this.problem(error, () => undefined));
    $("format").replaceChildren(...formats.map((format) => el("option", { value: format }, format)));
    if (asked.pdb) return this.open(() => Promise.resolve(entry(asked.pdb)));
    if (asked.structure) return this.open((signal) => this.known(asked.structure, signal));
    await this.sample();
  }

  /** Words where there is no surface. */
  greet(name: string, title: string): void {
    $("structure-name").textContent = name;
    $("structure-title").textContent = title;
  }

  /** Shows a failure. */
  problem(error: unknown, again: () => void): void {
    const found = asProblem(error);
    showProblem($("problem"), found, {
      takeResolution: (resolution) => this.form?.set("resolution", String(resolution)),
      reset: (parameter) => this.form?.set(parameter, undefined),
      again,
    });
    this.say(`${found.document.title}. ${found.document.detail ?? ""}`);
  }

  /** Takes failures away. */
  clear(): void {
    show($("problem"), false);
  }

  private get choices() {
    return this.form?.choices ?? new Map<string, string>();
  }

  private choicesOf(format: string) {
    return this.form?.of(format) ?? new Map<string, string>();
  }

  private listen(): void {
    const file = $<HTMLInputElement>("file");
    const take = (chosen: File) => void this.open((signal) => upload(this.client, chosen, chosen.name, signal));
    file.addEventListener("change", () => {
      const chosen = file.files?.[0];
      if (chosen) take(chosen);
      file.value = "";
    });
    drops(take);
    $("pdb-form").addEventListener("submit", (event) => {
      event.preventDefault();
      const id = $<HTMLInputElement>("pdb").value.trim();
      if (id) void this.open(() => Promise.resolve(entry(id)));
    });
    $("sample").addEventListener("click", () => void this.sample());
    $("cancel").addEventListener("click", () => {
      this.opening?.abort();
      this.remesher.cancel();
      this.say("Cancelled");
    });
    $("reset-all").addEventListener("click", () => {
      this.form?.fill(new Map());
      this.changed(false);
    });
    $("format").addEventListener("change", () => this.commands());
    const copied = (id: string, text: () => string) => $(id).addEventListener("click", () => void copy(text()).then(() => this.say("Copied"), (error: unknown) => this.problem(error, () => undefined)));
    copied("copy-curl", () => $("curl").textContent ?? "");
    copied("copy-url", () => (this.source ? location.origin + surface(this.source, $<HTMLSelectElement>("format").value, this.choicesOf($<HTMLSelectElement>("format").value)) : ""));
  }

  private sample(): Promise<void> {
    return this.open(async (signal) => {
      const blob = await (await this.client.ask(`/${SAMPLE}`, { signal })).blob();
      return upload(this.client, blob, SAMPLE, signal);
    });
  }

  /** A structure that was uploaded before. */
  private async known(digest: string, signal: AbortSignal): Promise<Source> {
    const summary = await this.client.json<Summary>(`/v1/structures/${encodeURIComponent(digest)}`, { signal });
    return { path: `/v1/structures/${summary.digest}`, name: summary.id ?? "structure", file: `${(summary.id ?? "structure").toLowerCase()}.cif`, summary };
  }

  /** Opens another structure. */
  private async open(find: (signal: AbortSignal) => Promise<Source>): Promise<void> {
    this.opening?.abort();
    this.remesher.cancel();
    this.clear();
    const abort = (this.opening = new AbortController());
    this.wait("Reading the structure…", null);
    try {
      const source = await find(abort.signal);
      if (abort.signal.aborted) return;
      this.source = source;
      this.greet(source.name, source.summary?.title ?? "");
      const chains = source.summary?.chains.map((c) => c.name || "_").slice(0, 12).join(",");
      this.form?.hint("chains", chains ? `all: ${chains}` : "all");
      this.changed(false);
    } catch (error) {
      if (abort.signal.aborted) return;
      this.idle();
      this.problem(error, () => void this.open(find));
    }
  }

  /** Something was set: the mesh follows. */
  private changed(live: boolean, since = performance.now()): void {
    const { source, choices } = this;
    if (!source) return;
    this.commands();
    const known = this.shown?.source === source ? this.shown : null;
    if (live && known && known.took > PREVIEW_FROM) {
      const set = Number(choices.get("resolution"));
      const resolution = Number((2 * (set > 0 ? set : known.resolution)).toPrecision(3));
      return this.remesher.want({ path: drawn(source, choices, resolution), preview: resolution, live, since });
    }
    this.remesher.want({ path: drawn(source, choices), live, since });
  }

  private commands(): void {
    const all = this.form?.all ?? new Map<string, string>();
    show($("reset-all"), all.size > 0);
    if (!this.source) return;
    writeAddress(this.source, all);
    const format = $<HTMLSelectElement>("format").value || "glb";
    $("curl").textContent = curl(this.source, format, this.choicesOf(format), location.origin, this.client.key !== "");
  }

  private begin(wish: Wish): void {
    this.clear();
    this.wait("Meshing…", null, wish.live ? 600 : 250);
  }

  /** Says that something takes its time, but not of what is done at once. */
  private wait(words: string, fraction: number | null, after = 250): void {
    clearTimeout(this.busy);
    const bar = $<HTMLProgressElement>("progress");
    if (fraction === null) bar.removeAttribute("value");
    else bar.value = fraction;
    $("busy-text").textContent = words;
    $("stage").setAttribute("aria-busy", "true");
    if ($("busy").hidden) this.busy = window.setTimeout(() => show($("busy"), true), after);
  }

  private progress({ status, stage, fraction }: Job): void {
    const words = status === "accepted" ? "Waiting for its turn…" : `${stage ?? "meshing"}, ${Math.round(100 * fraction)} %`;
    this.wait(words, status === "accepted" ? null : fraction, 0);
  }

  private idle(): void {
    clearTimeout(this.busy);
    show($("busy"), false);
    $("stage").removeAttribute("aria-busy");
  }

  private async show({ wish, answered, received, bytes, headers }: Delivery): Promise<void> {
    const source = this.source;
    if (!source) return;
    const fresh = this.shown?.source !== source;
    const first = this.shown === null;
    const { loaded, drawn: time } = await this.stage.show(bytes, source, this.choicesOf("png"), fresh);
    // What web/measure.mjs reads.
    const parts = { answered: answered - wish.since, received: received - answered, drawn: time - received };
    performance.measure("molmesh:remesh", { start: wish.since, end: time, detail: { preview: wish.preview ?? null, triangles: loaded.extras["triangles"], ...parts } });
    const preview = $("preview");
    show(preview, wish.preview !== undefined);
    preview.textContent = wish.preview === undefined ? "" : `preview at ${number(wish.preview, 2)} Å`;
    if (wish.preview !== undefined) return;
    const took = time - wish.since;
    this.shown = { source, resolution: Number(loaded.extras["resolution"] ?? 0.5), took };
    if (fresh) this.label(source);
    if (first) this.stage.viewer?.turn(true);
    if (!source.summary) this.greet(source.name, String(loaded.extras["title"] ?? ""));
    this.form?.tell(loaded.extras);
    report($("report"), loaded.extras, timingsOf(headers));
    const { triangles } = loaded.extras;
    $("now").textContent = `${Number(triangles).toLocaleString("en")} triangles, ${number(took, 3)} ms from wish to screen`;
    this.later(() => this.complete(source, loaded.extras, headers));
  }

  /** What differs from run to run, and words for those who hear the page: not while something else follows at once. */
  private later(then: () => void): void {
    clearTimeout(this.facts);
    this.facts = window.setTimeout(then, 300);
  }

  private complete(source: Source, extras: Record<string, unknown>, headers: Headers): void {
    const closed = extras["closed"] === true ? "closed" : "not closed";
    this.say(`Surface of ${source.name}: ${Number(extras["triangles"]).toLocaleString("en")} triangles, area ${number(Number(extras["area"]), 4)} Å², ${closed}.`);
    const key = /\/v1\/results\/([0-9a-f]{64})\./.exec(headers.get("content-location") ?? "")?.[1];
    if (!key) return;
    const shown = this.shown;
    this.client.json<Record<string, unknown>>(`/v1/results/${key}/report.json`).then(
      (document) => {
        if (this.shown === shown) report($("report"), document, timingsOf(headers, document));
      },
      // A result that is not kept has no report of its own: what the file says is there already.
      () => undefined,
    );
  }

  private label(source: Source): void {
    this.labelling?.abort();
    const abort = (this.labelling = new AbortController());
    this.picker?.know(null);
    labels(this.client, source, abort.signal).then(
      (found: Labels) => abort.signal.aborted || this.picker?.know(found),
      // Without labels atoms go by their numbers.
      () => undefined,
    );
  }

  private failed(error: unknown, wish: Wish): void {
    const { source } = this;
    // The service keeps structures for some time only; this page has the bytes.
    if (error instanceof Problem && error.is("no-such-structure") && source?.blob) {
      void this.open((signal) => upload(this.client, source.blob as Blob, source.file, signal));
      return;
    }
    show($("preview"), false);
    this.problem(error, () => this.remesher.want({ ...wish, since: performance.now() }));
  }

  private say(words: string): void {
    $("live").textContent = words;
  }
}
