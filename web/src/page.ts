/** Controller of the page: structures, parameters and meshes. */

import { type Client, Problem } from "../client/src/index";
import { asProblem } from "./api/problem";
import type { Legend } from "./api/colors";
import type { Parameter, Schemes } from "./api/schema";
import { entry, type Source, stored, upload } from "./api/structures";
import { Colors } from "./colors";
import { connect } from "./controls";
import { Display, type DisplayState } from "./display";
import { Downloads } from "./downloads";
import { keyboard } from "./keyboard";
import { type TilesetPaths, tilesetOf } from "./large";
import { Picker } from "./picker";
import { type Delivery, Remesher, type MeshRequest } from "./remesh";
import { addressOf, type Choices, coarser, curl, currentAddress, drawn, readAddress, SAMPLE, type State, surface, writeAddress } from "./request";
import { Stage } from "./stage";
import { Busy } from "./ui/busy";
import { ColourControls } from "./ui/colours";
import { $, el, number, show } from "./ui/dom";
import { Form } from "./ui/form";
import { problem as showProblem } from "./ui/problem";
import { report, storedReport, timingsOf } from "./ui/report";
import { showTiles } from "./ui/tiles";

/** Time from input to frame, ms, above which a dragged slider shows a coarser preview. */
const PREVIEW_FROM = 200;

export class Page {
  readonly stage: Stage;
  private readonly remesher: Remesher;
  private readonly picker: Picker | null;
  private readonly colors: Colors | null;
  private readonly display: Display | null;
  private readonly colourControls = new ColourControls((scheme) => this.recolour(scheme), (palette) => this.form?.set("palette", palette));
  private form: Form | null = null;
  /**
   * The shown surface with its structure and parameters. Caption, address, command line, report and downloads describe
   * only this surface.
   */
  private shown: { source: Source; choices: Choices; legend: Legend | null; resolution: number; took: number } | null = null;
  /** Structure of the next mesh. After a failure, the structure of the shown surface, if there is one. */
  private target: Source | null = null;
  /** Display of the next mesh; null if it does not change. */
  private nextDisplay: DisplayState | null = null;
  private opening: AbortController | null = null;
  /** Structures shown so far, by path, so that returning to one needs no second upload. */
  private readonly visited = new Map<string, Source>();
  /** Names of the parameters that apply to tilesets. */
  private ofTilesets: ReadonlySet<string> = new Set();
  private facts = 0;
  private readonly busy = new Busy();

  constructor(private readonly client: Client) {
    this.stage = new Stage(client, {
      turned: (turning) => $("turn").setAttribute("aria-pressed", String(turning)),
      partsChanged: () => this.updateAddress(),
      tiles: (state) => showTiles($("now"), state),
      failed: (error, again) => this.problem(error, () => (this.clear(), again()), this.shown?.source.name),
    });
    const { viewer } = this.stage;
    this.picker = viewer && new Picker(client, viewer, (text) => this.announce(text));
    this.colors = viewer && new Colors(client, viewer, (legend) => this.colourControls.explain(legend), false);
    this.display = viewer && new Display(client, viewer, {
      changed: () => this.updateAddress(),
      divide: (byChain) => this.form?.set("split", byChain ? "chain" : undefined),
      failed: (error) => this.problem(error, () => undefined, this.shown?.source.name),
    });
    if (viewer && this.picker) keyboard($("view-home"), viewer, this.picker);
    for (const id of ["turn", "home", "colour", "display"]) show($(id), viewer !== null);
    $("turn").addEventListener("click", () => viewer?.turn(!viewer.isTurning, true));
    $("home").addEventListener("click", () => viewer?.reset());
    this.remesher = new Remesher(client, {
      begin: (request) => this.begin(request),
      tileset: (request) => this.tileset(request),
      progress: (job) => this.busy.follow(job),
      show: (delivery) => this.show(delivery),
      failed: (error, request) => this.failed(error, request),
      idle: () => this.idle(),
    });
    this.listen();
  }

  /** Builds the form from the OpenAPI document and opens the structure that the address names. */
  async start(parameters: Parameter[], formats: string[], schemes: Schemes, ofTilesets: ReadonlySet<string>): Promise<void> {
    this.ofTilesets = ofTilesets;
    this.colourControls.fill(schemes);
    const form = new Form($("parameters"), $("picture-fields"), parameters, schemes, (mesh, live) => (mesh ? this.changed(live) : this.displayChanged()));
    this.form = form;
    const wanted = (format: string) => this.shown && { source: this.shown.source, choices: form.of(format, this.shown.choices) };
    new Downloads(this.client, formats, wanted, (error, source) => this.problem(error, () => undefined, source.name));
    $("format").replaceChildren(...formats.map((format) => el("option", { value: format }, format)));
    await this.visit();
  }

  /** Opens the structure that the address names, else the sample, with the parameters of the address. */
  private async visit(): Promise<void> {
    if (!this.form) return;
    const { pdb, structure, ...state } = readAddress(this.form.names);
    if (pdb) return this.open(pdb.toUpperCase(), () => Promise.resolve(entry(pdb)), state);
    if (structure) return this.open(`Structure ${structure.slice(0, 8)}`, (signal) => this.known(structure, signal), state);
    await this.sample(state);
  }

  /** Sets the caption over the surface. */
  setCaption(name: string, title: string): void {
    $("structure-name").textContent = name;
    $("structure-title").textContent = title;
  }

  /**
   * Shows an error, and the structure `name` that it concerns. If a mesh failed, the remedies change its `request`
   * instead of the parameters of the surface shown.
   */
  problem(error: unknown, again: () => void, name = "", request?: MeshRequest): void {
    const found = asProblem(error);
    const set = (parameter: string, value: string | undefined) => {
      if (request) this.take(request);
      this.form?.set(parameter, value);
    };
    const shown = this.shown?.source.name;
    const isOther = name && shown && name !== shown;
    const same = shown && request ? "The surface and its parameters are as they were before." : "";
    const kept = isOther ? `The surface shown is still that of ${shown}.` : same;
    showProblem($("problem"), found, { name, kept }, {
      takeResolution: (resolution) => set("resolution", String(resolution)),
      reset: (parameter) => set(parameter, undefined),
      again,
    });
    this.announce(`${name ? `${name}: ` : ""}${found.document.title}. ${found.document.detail ?? ""} ${kept}`.trim());
  }

  /** Hides the error message. */
  clear(): void {
    show($("problem"), false);
  }

  private listen(): void {
    connect({
      openFile: (file) => void this.open(file.name, (signal) => upload(this.client, file, file.name, signal)),
      openEntry: (id) => void this.open(id.toUpperCase(), () => Promise.resolve(entry(id))),
      openSample: () => void this.sample(),
      cancel: () => this.cancel(),
      reset: () => {
        this.form?.fill(new Map());
        this.changed(false);
      },
      formatChanged: () => this.updateAddress(),
      address: () => {
        const format = $<HTMLSelectElement>("format").value;
        return this.shown && this.form ? location.origin + surface(this.shown.source, format, this.form.of(format, this.shown.choices)) : "";
      },
      copied: () => this.announce("Copied"),
      copyFailed: (error) => this.problem(error, () => undefined),
    });
    window.addEventListener("popstate", () => {
      // A step to another fragment of the same address opens nothing.
      if (this.address !== currentAddress()) void this.visit();
    });
  }

  private cancel(): void {
    this.opening?.abort();
    this.opening = null;
    this.remesher.cancel();
    this.restore();
    this.announce(this.shown ? `Cancelled. The surface shown is that of ${this.shown.source.name}.` : "Cancelled");
  }

  private sample(state: State | null = null): Promise<void> {
    return this.open("The sample", async (signal) => {
      const blob = await (await this.client.ask(`/${SAMPLE}`, { signal })).blob();
      return { ...(await upload(this.client, blob, SAMPLE, signal)), isSample: true };
    }, state);
  }

  /** Returns a structure that was uploaded before. */
  private async known(digest: string, signal: AbortSignal): Promise<Source> {
    return this.visited.get(`/v1/structures/${digest}`) ?? stored(this.client, digest, signal);
  }

  /**
   * Opens another structure, which `find` resolves with, with the parameters and display in `state`. Without it they
   * stay, except those that name parts of the previous structure. The page describes the previous one until the mesh
   * arrives.
   */
  private async open(name: string, find: (signal: AbortSignal) => Promise<Source>, state: State | null = null): Promise<void> {
    this.opening?.abort();
    this.remesher.cancel();
    this.clear();
    const abort = (this.opening = new AbortController());
    this.busy.show(`Reading ${name}…`, null);
    try {
      const source = await find(abort.signal);
      if (abort.signal.aborted) return;
      this.opening = null;
      const isOther = source.path !== this.target?.path;
      if (state) this.form?.fill(state.choices);
      else if (isOther) this.form?.forget();
      if (state) this.nextDisplay = state.display;
      else if (isOther && this.display) this.nextDisplay = { ...this.display.state, hidden: [], view: "" };
      this.target = source;
      this.changed(false);
    } catch (error) {
      if (abort.signal.aborted) return;
      this.opening = null;
      this.restore();
      this.problem(error, () => void this.open(name, find, state), name);
    }
  }

  /** Requests a mesh after a parameter was set. A structure that is being opened takes the parameters set by then. */
  private changed(live: boolean, since = performance.now()): void {
    const { form, target: source } = this;
    if (!form) return;
    this.updateReset();
    if (!source || this.opening) return;
    const choices = form.all;
    const known = this.shown?.source.path === source.path ? this.shown : null;
    const display = this.nextDisplay;
    if (live && known && known.took > PREVIEW_FROM) {
      const set = Number(choices.get("resolution"));
      const preview = Number((2 * (set > 0 ? set : known.resolution)).toPrecision(3));
      const path = drawn(source, form.mesh(coarser(choices, preview)));
      return this.remesher.want({ source, choices, display, path, preview, live, since });
    }
    this.remesher.want({ source, choices, display, path: drawn(source, form.mesh(choices)), live, since });
  }

  /** Sets a colour scheme. Resets palette and range, which may not apply to the new scheme. */
  private recolour(scheme: string): void {
    for (const name of ["palette", "color_range"]) this.form?.put(name, undefined);
    this.form?.set("color", scheme === "none" ? undefined : scheme);
  }

  /** Applies the colours of the parameters to the surface shown. */
  private paint(): void {
    const { shown } = this;
    if (!shown) return;
    this.colourControls.choose(shown.choices);
    if (shown.legend && this.form?.coloursVertices(shown.choices)) return this.colors?.useFile(shown.source.path, shown.legend);
    this.colors?.apply(shown.source.path, shown.choices).catch((error: unknown) => this.problem(error, () => this.paint(), shown.source.name));
  }

  /** Updates colours, downloads and command line after a change of a parameter that does not affect the mesh. */
  private displayChanged(): void {
    const { form, shown } = this;
    this.updateReset();
    if (!form || !shown) return;
    shown.choices = form.displayed(shown.choices);
    this.paint();
    this.updateAddress();
  }

  /** Sets structure and parameters of `request` as the next ones to mesh. */
  private take(request: MeshRequest): void {
    this.target = request.source;
    this.nextDisplay = request.display;
    this.form?.fill(request.choices);
  }

  /**
   * Returns to the surface shown after a request failed or was cancelled: parameters, address, and the full mesh in
   * place of a preview.
   */
  private restore(): void {
    this.idle();
    this.nextDisplay = null;
    const { shown } = this;
    if (!shown) return this.setCaption("No surface", "");
    this.target = shown.source;
    this.form?.fill(shown.choices);
    this.display?.follow(shown.source, shown.choices);
    this.updateReset();
    this.stage.restore();
    show($("preview"), false);
    this.updateAddress();
  }

  private updateReset(): void {
    show($("reset-all"), (this.form?.all.size ?? 0) > 0);
  }

  /** Address of the page for the shown surface; empty if there is none. */
  private get address(): string {
    return this.shown ? addressOf(this.shown.source, this.shown.choices, this.display?.state ?? null) : "";
  }

  /** Updates the address and the command line; `push` adds the address to the history. */
  private updateAddress(push = false): void {
    const { shown, form } = this;
    if (!shown || !form) return;
    writeAddress(this.address, push);
    const format = $<HTMLSelectElement>("format").value || "glb";
    const choices = form.of(format, shown.choices);
    $("curl").textContent = curl(shown.source, format, choices, location.origin, this.client.key !== "");
  }

  private begin(request: MeshRequest): void {
    this.clear();
    this.busy.show("Meshing…", null, request.live ? 600 : undefined);
  }

  /** Returns the tileset of a surface that may be too large for one file. */
  private tileset({ source, choices }: MeshRequest): TilesetPaths | null {
    const { form } = this;
    return !form || !this.stage.viewer || form.coloursVertices(choices) ? null : tilesetOf(source, form.mesh(choices), this.ofTilesets);
  }

  private idle(): void {
    if (!this.opening) this.busy.hide();
  }

  /** Shows a received mesh. The page changes in one step, once everything is ready. */
  private async show({ request, answered, received, bytes, headers, tileset, signal }: Delivery): Promise<void> {
    const { form } = this;
    if (!form) return;
    const { source, preview } = request;
    const taken = preview === undefined ? request.choices : coarser(request.choices, preview);
    const scene = await this.stage.prepare(bytes, source, form.of("png", taken), tileset, signal);
    signal.throwIfAborted();
    const { extras } = scene.loaded;
    const previous = this.address;
    if (preview === undefined && request.display && this.display) {
      this.display.state = request.display;
      this.nextDisplay = null;
    }
    const drawing = this.stage.show(scene, this.shown?.source.path !== source.path, preview !== undefined);
    show($("preview"), preview !== undefined);
    $("preview").textContent = preview === undefined ? "" : `preview at ${number(preview, 2)} Å`;
    if (preview === undefined) this.commit(request, extras, headers, tileset, previous);
    const { shown } = this;
    const time = await drawing;
    // Read by web/measure.mjs.
    const parts = { answered: answered - request.since, received: received - answered, drawn: time - received };
    performance.measure("molmesh:remesh", { start: request.since, end: time, detail: { preview: preview ?? null, triangles: extras["triangles"], ...parts } });
    if (preview !== undefined || !shown || this.shown !== shown) return;
    shown.took = time - request.since;
    $("now").textContent += `, ${number(shown.took, 3)} ms from input to frame`;
  }

  /** Updates the page to describe the mesh of the request, which is now shown. `address` is that of the one before. */
  private commit({ source, choices }: MeshRequest, extras: Record<string, unknown>, headers: Headers, tileset: TilesetPaths | null, address: string): void {
    const { form, shown: previous } = this;
    if (!form) return;
    const isOther = previous?.source.path !== source.path;
    // After a step through the history, the address is already set.
    const push = isOther && previous !== null && address === currentAddress();
    const legend = (extras["color"] ?? null) as Legend | null;
    this.shown = { source, choices: form.displayed(choices), legend, resolution: Number(extras["resolution"] ?? 0.5), took: previous?.took ?? 0 };
    source.resent = false;
    source.atoms ??= Number(extras["atoms_in_file"]) || undefined;
    this.visited.set(source.path, source);
    this.setCaption(source.name, source.summary?.title ?? String(extras["title"] ?? ""));
    document.title = `${source.name} · molmesh`;
    if (isOther) {
      const chains = source.summary?.chains.map((c) => c.name || "_").slice(0, 12).join(",");
      form.hint("chains", chains ? `all: ${chains}` : "all");
      form.offer("assembly", source.summary?.assemblies.map(({ id, copies }) => [id, copies === null ? id : `${id} (copies: ${copies})`]) ?? []);
      void this.picker?.follow(source);
    }
    this.paint();
    this.display?.follow(source, this.shown.choices);
    form.showValues(tileset ? { ...extras, resolution: undefined } : extras);
    report($("report"), extras, timingsOf(headers));
    show($("coarse"), tileset !== null);
    $("now").textContent = `${Number(extras["triangles"]).toLocaleString("en")} triangles`;
    this.updateAddress(push);
    if (!previous && !this.display?.state.view) this.stage.viewer?.turn(true);
    show($("joined"), choices.get("instances") === "true");
    // After a pause without further meshes.
    clearTimeout(this.facts);
    this.facts = window.setTimeout(() => void this.complete(source, extras, headers), 300);
  }

  private async complete(source: Source, extras: Record<string, unknown>, headers: Headers): Promise<void> {
    const closed = extras["closed"] === true ? "closed" : "not closed";
    this.announce(`Surface of ${source.name}: ${Number(extras["triangles"]).toLocaleString("en")} triangles, area ${number(Number(extras["area"]), 4)} Å², ${closed}.`);
    const shown = this.shown;
    const document = await storedReport(this.client, headers);
    if (document && this.shown === shown) report($("report"), document, timingsOf(headers, document));
  }

  private failed(error: unknown, request: MeshRequest): void {
    const { source } = request;
    const { blob } = source;
    // The service stores structures for a limited time; this page still has the bytes.
    if (error instanceof Problem && error.is("no-such-structure") && blob && !source.resent) {
      void this.open(source.name, async (signal) => ({ ...source, ...(await upload(this.client, blob, source.file, signal)), resent: true }));
      return;
    }
    this.restore();
    const again = () => (this.take(request), this.changed(false));
    this.problem(error, again, source.name, request);
  }

  private announce(text: string): void {
    $("live").textContent = text;
  }
}
