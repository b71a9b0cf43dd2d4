/** `<molmesh-viewer src="…/surface.glb">`: a surface in any page. */

import { bytesOf } from "./api/bytes";
import { load } from "./scene/load";
import { contextOf, Viewer } from "./scene/viewer";

const ATTRIBUTES = ["src", "color", "background", "turn", "alt"] as const;

export class MolmeshViewer extends HTMLElement {
  static readonly observedAttributes: readonly string[] = ATTRIBUTES;
  private viewer: Viewer | null = null;
  private abort: AbortController | null = null;
  private readonly canvas = document.createElement("canvas");

  connectedCallback(): void {
    const root = this.shadowRoot ?? this.attachShadow({ mode: "open" });
    // Styles are set through the document's objects, which no content security policy forbids.
    const sheet = new CSSStyleSheet();
    sheet.replaceSync(":host{display:block;position:relative;min-height:12rem}canvas{position:absolute;inset:0;width:100%;height:100%;display:block;touch-action:none}canvas:focus-visible{outline:2px solid Highlight;outline-offset:-2px}");
    root.adoptedStyleSheets = [sheet];
    root.replaceChildren(this.canvas);
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    const gl = contextOf(this.canvas, true);
    if (!gl) {
      // What the page has put between the tags stands in, such as a picture.
      root.replaceChildren(document.createElement("slot"));
      return this.fail(new Error("this browser has no WebGL 2"));
    }
    this.viewer ??= new Viewer(this.canvas, gl, { transparent: true, onLost: (lost) => this.tell(lost ? "contextlost" : "contextrestored", {}) });
    this.canvas.addEventListener("click", (event) => this.clicked(event));
    this.canvas.addEventListener("keydown", (event) => this.pressed(event));
    this.dress();
    if (this.src) void this.load(this.src);
  }

  disconnectedCallback(): void {
    this.abort?.abort();
    this.viewer?.dispose();
    this.viewer = null;
  }

  attributeChangedCallback(name: (typeof ATTRIBUTES)[number], before: string | null, after: string | null): void {
    if (!this.viewer || before === after) return;
    if (name === "src") void this.load(after ?? "");
    else this.dress();
  }

  get src(): string {
    return this.getAttribute("src") ?? "";
  }

  set src(value: string) {
    this.setAttribute("src", value);
  }

  /** Loads another file. What was on its way is cancelled: the latest one wins. */
  private async load(src: string): Promise<void> {
    this.abort?.abort();
    const abort = (this.abort = new AbortController());
    if (!src) return;
    try {
      const reply = await fetch(src, { signal: abort.signal });
      if (reply.status !== 200) throw new Error(`${src}: ${reply.status} ${reply.statusText}`);
      const loaded = await load(await bytesOf(reply));
      if (abort.signal.aborted) return;
      await this.viewer?.show(loaded, true);
      if (this.hasAttribute("turn")) this.viewer?.turn(true);
      this.tell("load", { report: loaded.extras });
    } catch (error) {
      if (!abort.signal.aborted) this.fail(error as Error);
    }
  }

  private clicked(event: MouseEvent): void {
    const { clientWidth, clientHeight } = this.canvas;
    const hit = this.viewer?.pick((2 * event.offsetX) / clientWidth - 1, 1 - (2 * event.offsetY) / clientHeight);
    const atom = hit && hit.atom >= 0 ? hit.atom : null;
    this.viewer?.mark("pinned", atom === null ? null : [atom, atom]);
    this.tell("pick", { atom, point: hit?.point.toArray() ?? null });
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

  private dress(): void {
    this.canvas.setAttribute("aria-label", this.getAttribute("alt") ?? "A molecular surface; arrow keys turn it");
    this.style.background = this.getAttribute("background") ?? "";
    this.viewer?.theme(this.getAttribute("background") ?? "#ffffff", this.getAttribute("color") ?? "#58ad9d");
  }

  private fail(error: Error): void {
    this.tell("error", { message: error.message });
  }

  private tell(name: string, detail: unknown): void {
    this.dispatchEvent(new CustomEvent(`molmesh-${name}`, { detail, bubbles: true }));
  }
}

if (!customElements.get("molmesh-viewer")) customElements.define("molmesh-viewer", MolmeshViewer);
