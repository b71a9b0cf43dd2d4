/** `<molmesh-viewer src="…/surface.glb">`: a surface in any page. */

import { bytesOf } from "./api/bytes";
import type { JobDocument } from "../client/dist/api";
import { Client } from "../client/src/client";
import { Problem } from "../client/src/problem";
import type { MolmeshViewerAttributes, MolmeshViewerEvents } from "../client/src/viewer";
import { asProblem } from "./api/problem";
import { Colors } from "./colors";
import { tileFetcher, type TilesetPaths, tilesetAt } from "./large";
import { Ligands } from "./ligands";
import { load } from "./scene/load";
import { contextOf, transparencyOf } from "./scene/context";
import { Viewer } from "./scene/viewer";
import { chooseScheme, fillSchemes, showLegend } from "./ui/legend";

const ATTRIBUTES: Record<keyof MolmeshViewerAttributes, true> = {
  src: true, alt: true, color: true, scheme: true, menu: true, sticks: true, transparency: true, background: true, turn: true,
};

const STYLE = `
:host { display: block; position: relative; min-height: 12rem }
[hidden] { display: none !important }
canvas { position: absolute; inset: 0; width: 100%; height: 100%; display: block; touch-action: none }
canvas:focus-visible { outline: 2px solid Highlight; outline-offset: -2px }
select { position: absolute; right: .5rem; bottom: .5rem; font: inherit }
.legend { position: absolute; left: .5rem; bottom: .5rem; display: flex; flex-wrap: wrap; gap: 0 .6rem; align-items: center; max-width: 60%; padding: .1rem .4rem; background: Canvas; color: CanvasText; font-size: .8rem }
.swatch { display: inline-block; width: .7rem; height: .7rem; margin-right: .3rem }
.scale { width: 6rem; height: .7rem }
p { margin: 0; padding: 1rem; overflow-wrap: anywhere }
`;

export class MolmeshViewer extends HTMLElement {
  static readonly observedAttributes: readonly string[] = Object.keys(ATTRIBUTES);
  private readonly client = new Client(document.baseURI, { retries: 0 });
  private viewer: Viewer | null = null;
  private abort: AbortController | null = null;
  private readonly canvas = document.createElement("canvas");
  private readonly menu = document.createElement("select");
  private readonly legend = document.createElement("div");
  private colors: Colors | null = null;
  private ligands: Ligands | null = null;
  /** The content between the tags, shown if there is no surface. */
  private readonly fallback = document.createElement("slot");
  /** The reason why there is no surface, shown if there is no content between the tags. */
  private readonly reason = document.createElement("p");
  /** Reason why the surface of `src` is not shown; null if it is shown or loading. */
  private failure: string | null = null;
  private isLost = false;

  constructor() {
    super();
    const root = this.attachShadow({ mode: "open" });
    // Styles are set through the document's objects, which no content security policy forbids.
    const sheet = new CSSStyleSheet();
    sheet.replaceSync(STYLE);
    root.adoptedStyleSheets = [sheet];
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    this.canvas.addEventListener("click", (event) => this.clicked(event));
    this.canvas.addEventListener("keydown", (event) => this.pressed(event));
    this.reason.setAttribute("role", "alert");
    fillSchemes(this.menu);
    this.menu.setAttribute("aria-label", "Colours");
    this.menu.addEventListener("change", () => this.setAttribute("scheme", this.menu.value));
    this.legend.className = "legend";
    root.append(this.canvas, this.legend, this.menu, this.fallback, this.reason);
    this.arrange();
  }

  connectedCallback(): void {
    const gl = contextOf(this.canvas, true);
    if (!gl) return this.fail(new Error("this browser has no WebGL 2"));
    try {
      this.viewer ??= new Viewer(this.canvas, gl, { transparent: true, onLost: (lost) => this.lost(lost) });
    } catch (error) {
      return this.fail(error);
    }
    this.colors ??= new Colors(this.client, this.viewer, (legend) => showLegend(this.legend, legend), true);
    this.ligands ??= new Ligands(this.client, this.viewer, () => undefined);
    this.applyAttributes();
    void this.load(this.src);
  }

  disconnectedCallback(): void {
    this.abort?.abort();
    this.colors?.stop();
    this.ligands?.clear();
    this.viewer?.dispose();
    this.viewer = null;
    this.colors = null;
    this.ligands = null;
  }

  attributeChangedCallback(name: keyof MolmeshViewerAttributes, before: string | null, after: string | null): void {
    if (!this.viewer || before === after) return;
    if (name === "src") void this.load(after ?? "");
    else if (name === "scheme" || name === "sticks") this.paint();
    else this.applyAttributes();
  }

  get src(): string {
    return this.getAttribute("src") ?? "";
  }

  set src(value: string) {
    this.setAttribute("src", value);
  }

  /** Loads another file, through a job if the service makes it one. Cancels the previous request. */
  private async load(src: string): Promise<void> {
    this.abort?.abort();
    const { signal } = (this.abort = new AbortController());
    if (!src) return this.arrange("");
    try {
      const onProgress = ({ status, stage, fraction }: JobDocument) => this.tell("molmesh-progress", { status, stage, fraction });
      const tileset = tilesetAt(src);
      const reply = await this.client.file(tileset?.root ?? src, { signal, onProgress });
      const loaded = await load(await bytesOf(reply));
      signal.throwIfAborted();
      // The canvas has a size only while it is visible.
      this.arrange();
      this.paint();
      await this.viewer?.show(loaded, true);
      signal.throwIfAborted();
      if (tileset) void this.refine(tileset);
      if (this.hasAttribute("turn")) this.viewer?.turn(true);
      this.tell("molmesh-load", { report: loaded.extras });
    } catch (error) {
      if (!signal.aborted) this.fail(error);
    }
  }

  /** Shows the tiles of a tileset as the view needs them. */
  private async refine(tileset: TilesetPaths): Promise<void> {
    const failed = (error: unknown) => this.report(error);
    await this.viewer?.refine(tileset.document, tileFetcher(this.client), (state) => this.tell("molmesh-tiles", state), failed);
  }

  /** Shows the canvas, or, with the reason `failure`, the fallback. */
  private arrange(failure: string | null = null): void {
    this.failure = failure;
    const reason = failure ?? (this.isLost ? "the graphics device was lost" : null);
    this.canvas.hidden = reason !== null;
    this.fallback.hidden = reason === null;
    const isEmpty = this.childElementCount === 0 && !this.textContent?.trim();
    this.reason.textContent = reason;
    this.reason.hidden = !reason || !isEmpty;
  }

  private lost(lost: boolean): void {
    this.isLost = lost;
    this.arrange(this.failure);
    this.tell(lost ? "molmesh-contextlost" : "molmesh-contextrestored", {});
  }

  private clicked(event: MouseEvent): void {
    const { clientWidth, clientHeight } = this.canvas;
    const hit = this.viewer?.pick((2 * event.offsetX) / clientWidth - 1, 1 - (2 * event.offsetY) / clientHeight);
    const atom = hit && hit.atom >= 0 ? hit.atom : null;
    this.viewer?.mark("pinned", atom === null ? null : [atom, atom]);
    this.tell("molmesh-pick", { atom, point: hit?.point.toArray() ?? null });
  }

  private pressed(event: KeyboardEvent): void {
    const step = Math.PI / 18;
    const moves: Record<string, [number, number, number]> = {
      ArrowLeft: [-step, 0, 1], ArrowRight: [step, 0, 1], ArrowUp: [0, -step, 1], ArrowDown: [0, step, 1], "+": [0, 0, 1.15], "-": [0, 0, 1 / 1.15],
    };
    const move = moves[event.key];
    if (!move || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    this.viewer?.move(...move);
  }

  /** Applies the attributes `scheme` and `sticks` to a surface of this service. */
  private paint(): void {
    const scheme = this.getAttribute("scheme") ?? "none";
    chooseScheme(this.menu, scheme);
    const { pathname, searchParams, origin } = new URL(this.src, document.baseURI);
    const structure = /^(.*\/v1\/(?:pdb|structures)\/[^/]+)\/(?:surface\.glb|tileset\.json)$/.exec(pathname)?.[1];
    this.menu.hidden = !this.hasAttribute("menu") || !structure;
    if (!structure || !this.hasAttribute("sticks")) this.ligands?.clear();
    if (!structure) return showLegend(this.legend, null);
    const failed = (error: unknown) => this.report(error);
    const choices = new Map([...searchParams, ["color", scheme]] as [string, string][]);
    this.colors?.apply(origin + structure, choices).catch(failed);
    if (this.hasAttribute("sticks")) this.ligands?.show(origin + structure, choices).catch(failed);
  }

  private applyAttributes(): void {
    this.paint();
    this.canvas.setAttribute("aria-label", this.getAttribute("alt") ?? "A molecular surface; arrow keys turn it");
    this.style.background = this.getAttribute("background") ?? "";
    this.viewer?.setTransparency(transparencyOf(this.getAttribute("transparency")) / 100);
    this.viewer?.theme(this.getAttribute("background") ?? "#ffffff", this.getAttribute("color") ?? "#58ad9d");
  }

  /** Reports an error; the surface stays visible. */
  private report(error: unknown): void {
    const { document } = asProblem(error);
    this.tell("molmesh-error", { message: document.detail ?? document.title, problem: error instanceof Problem ? document : null });
  }

  private fail(error: unknown): void {
    const { document } = asProblem(error);
    const words = [document.title, document.detail].filter(Boolean).join(": ");
    const message = this.src ? `${this.src}: ${words}` : words;
    this.arrange(message);
    this.tell("molmesh-error", { message, problem: error instanceof Problem ? document : null });
  }

  private tell<Name extends keyof MolmeshViewerEvents>(name: Name, detail: MolmeshViewerEvents[Name]["detail"]): void {
    this.dispatchEvent(new CustomEvent(name, { detail, bubbles: true }));
  }
}

if (!customElements.get("molmesh-viewer")) customElements.define("molmesh-viewer", MolmeshViewer);
