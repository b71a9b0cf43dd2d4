/** `<molmesh-viewer src="…/surface.glb">`: a surface in any page. */

import type { JobDocument } from "../client/dist/api";
import { Client } from "../client/src/client";
import { Problem } from "../client/src/problem";
import type { MolmeshViewerAttributes, MolmeshViewerEvents } from "../client/src/viewer";
import { atomColors, type AtomColors, colorsPath } from "./api/colors";
import { asProblem } from "./api/problem";
import { keyboard } from "./keyboard";
import { tileFetcher, tilesetAt } from "./large";
import { fetchLigands, type Ligands, ligandsPath } from "./ligands";
import { draw, fetchMesh, type Mesh, type Scene } from "./mesh";
import { Slot } from "./queue";
import { contextOf, transparencyOf } from "./scene/context";
import type { TilesState } from "./scene/tiles";
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

/** The surface that the element shows. */
interface ElementScene extends Scene {
  /** Address of the structure in a service; null for other files. */
  structure: string | null;
  /** Scheme of its colours. */
  scheme: string;
}

export class MolmeshViewer extends HTMLElement {
  static readonly observedAttributes: readonly string[] = Object.keys(ATTRIBUTES);
  private readonly client = new Client(document.baseURI, { retries: 0 });
  private viewer: Viewer | null = null;
  private readonly meshes = new Slot<Mesh>();
  private readonly colors = new Slot<AtomColors>();
  private readonly ligands = new Slot<Ligands>();
  private readonly slots = [this.meshes, this.colors, this.ligands];
  /** Identifies the latest request. */
  private latest = {};
  /** The surface on the screen. */
  private scene: ElementScene | null = null;
  private readonly canvas = document.createElement("canvas");
  private readonly menu = document.createElement("select");
  private readonly legend = document.createElement("div");
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
    keyboard(this.canvas, () => this.viewer);
    this.reason.setAttribute("role", "alert");
    fillSchemes(this.menu);
    this.menu.setAttribute("aria-label", "Colours");
    this.menu.addEventListener("change", () => {
      // A scheme that was refused can be chosen again.
      if (this.getAttribute("scheme") === this.menu.value) void this.update();
      else this.setAttribute("scheme", this.menu.value);
    });
    this.legend.className = "legend";
    root.append(this.canvas, this.legend, this.menu, this.fallback, this.reason);
    this.describe();
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
    this.applyAttributes();
    void this.update();
  }

  disconnectedCallback(): void {
    this.stop();
    this.viewer?.dispose();
    this.viewer = null;
  }

  attributeChangedCallback(name: keyof MolmeshViewerAttributes, before: string | null, after: string | null): void {
    if (!this.viewer || before === after) return;
    if (name === "src" || name === "scheme" || name === "sticks") void this.update();
    else if (name === "menu") this.describe();
    else this.applyAttributes();
  }

  get src(): string {
    return this.getAttribute("src") ?? "";
  }

  set src(value: string) {
    this.setAttribute("src", value);
  }

  /** Shows the surface of the attributes in one step, once everything has arrived. Cancels the previous request. */
  private async update(): Promise<void> {
    const { src, viewer } = this;
    const [mine, since] = [(this.latest = {}), performance.now()];
    if (!src || !viewer) {
      this.stop();
      return this.arrange("");
    }
    try {
      const { scene, failures } = await this.fetch(src);
      if (this.latest !== mine) return;
      const { scene: previous } = this;
      const { mesh, colors } = (this.scene = scene);
      for (const slot of this.slots) slot.commit();
      // The canvas has a size only while it is visible.
      this.arrange();
      const drawing = draw(viewer, scene, previous, true);
      this.describe();
      for (const failure of failures) this.report(failure);
      const drawn = await drawing;
      // Read by the browser tests.
      const detail = { atoms: (colors?.rgba.length ?? 0) / 4 };
      if (colors !== previous?.colors) performance.measure("molmesh:recolor", { start: since, end: drawn, detail });
      if (mesh === previous?.mesh || mesh !== this.scene?.mesh) return;
      const tiles = (state: TilesState) => this.tell("molmesh-tiles", state);
      if (mesh.tileset) void viewer.refine(mesh.tileset.document, tileFetcher(this.client), tiles, (error) => this.report(error));
      if (this.hasAttribute("turn")) viewer.turn(true);
      this.tell("molmesh-load", { report: mesh.loaded.extras });
    } catch (error) {
      if (this.latest === mine) this.fail(error);
    }
  }

  /**
   * Fetches the surface of the attributes. Colours and sticks that fail stay as they are on the same mesh, and are
   * missing on another one. Throws if the mesh fails.
   */
  private async fetch(src: string): Promise<{ scene: ElementScene; failures: unknown[] }> {
    const { client } = this;
    const { pathname, searchParams, origin } = new URL(src, document.baseURI);
    const path = /^(.*\/v1\/(?:pdb|structures)\/[^/]+)\/(?:surface\.glb|tileset\.json)$/.exec(pathname)?.[1];
    const structure = path ? origin + path : null;
    const scheme = this.getAttribute("scheme") ?? "none";
    const choices = new Map([...searchParams, ["color", scheme]] as [string, string][]);
    const colors = structure && colorsPath(structure, choices);
    const ligands = structure && this.hasAttribute("sticks") ? ligandsPath(structure, choices) : null;
    const onProgress = ({ status, stage, fraction }: JobDocument) => this.tell("molmesh-progress", { status, stage, fraction });
    const request = { path: src, tileset: tilesetAt(src), isLarge: () => true, onProgress };
    const failures: unknown[] = [];
    const optional = <T>(result: Promise<T>) => result.catch((error: unknown) => void failures.push(error));
    const [mesh, atoms, sticks] = await Promise.all([
      this.meshes.request(src, (_, signal) => fetchMesh(client, { ...request, signal })),
      optional(this.colors.request(colors, (address, signal) => atomColors(client, address, signal))),
      optional(this.ligands.request(ligands, (_, signal) => fetchLigands(client, structure ?? "", choices, signal))),
    ]);
    const kept = mesh === this.scene?.mesh ? this.scene : { colors: null, scheme: "none", ligands: null };
    const isUseless = Boolean(atoms) && !hasAtoms(mesh);
    if (isUseless) failures.push(new Error("the attribute `scheme` needs a `src` with atom_ids=true"));
    const colored = atoms === undefined || isUseless ? { colors: kept.colors, scheme: kept.scheme } : { colors: atoms, scheme };
    return { scene: { mesh, structure, usesFile: true, ligands: sticks === undefined ? kept.ligands : sticks, ...colored }, failures };
  }

  /** Cancels all requests, and forgets the surface. */
  private stop(): void {
    this.latest = {};
    for (const slot of this.slots) slot.cancel();
    this.scene = null;
    this.describe();
  }

  /** Shows the legend and the menu of the surface on the screen. */
  private describe(): void {
    const { scene } = this;
    showLegend(this.legend, scene?.colors?.legend ?? null);
    chooseScheme(this.menu, scene?.scheme ?? "none");
    this.menu.hidden = !this.hasAttribute("menu") || !scene?.structure || !hasAtoms(scene.mesh);
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

  private applyAttributes(): void {
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
    this.stop();
    this.arrange(message);
    this.tell("molmesh-error", { message, problem: error instanceof Problem ? document : null });
  }

  private tell<Name extends keyof MolmeshViewerEvents>(name: Name, detail: MolmeshViewerEvents[Name]["detail"]): void {
    this.dispatchEvent(new CustomEvent(name, { detail, bubbles: true }));
  }
}

/** Returns true if the vertices name their atoms. */
const hasAtoms = ({ loaded }: Mesh): boolean => loaded.parts.some(({ geometry }) => geometry.hasAttribute("_atom"));

if (!customElements.get("molmesh-viewer")) customElements.define("molmesh-viewer", MolmeshViewer);
