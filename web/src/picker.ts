/** Atom selection: under the pointer, pinned by a click, or found by name. */

import type { Client } from "../client/src/client";
import { type Atom, type Labels, labels, nameOf, type Source } from "./api/structures";
import type { Viewer } from "./scene/viewer";
import { $, el, show } from "./ui/dom";

/** Triangle count above which only clicks search the mesh, since a search per pointer move would be too slow. */
const MAX_HOVER_TRIANGLES = 1_500_000;

export class Picker {
  /** Labels of the shown structure; null while they are not available. */
  private labels: Labels | null = null;
  private labelling: AbortController | null = null;
  private pinned: number | null = null;
  private readonly tip = $("tip");
  private readonly colour = $<HTMLSelectElement>("colour");
  private pending: { x: number; y: number } | null = null;

  constructor(private readonly client: Client, private readonly viewer: Viewer, private readonly announce: (text: string) => void) {
    const canvas = viewer.canvas;
    let down = { x: 0, y: 0, moved: true };
    canvas.addEventListener("pointerdown", ({ offsetX: x, offsetY: y }) => {
      down = { x, y, moved: false };
      this.hover(null);
    });
    canvas.addEventListener("pointermove", ({ offsetX: x, offsetY: y, buttons, pointerType }) => {
      if (Math.hypot(x - down.x, y - down.y) > 5) down.moved = true;
      if (buttons === 0 && pointerType !== "touch") this.soon({ x, y });
    });
    canvas.addEventListener("pointerleave", () => this.hover(null));
    canvas.addEventListener("click", ({ offsetX: x, offsetY: y }) => {
      if (!down.moved) this.pin(this.under(x, y));
    });
    $("unpin").addEventListener("click", () => this.pin(null));
    $("find-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.find($<HTMLInputElement>("find").value);
    });
  }

  /** Fetches the labels of the shown structure. Without labels, atoms are shown by number. */
  async follow(source: Source): Promise<void> {
    this.labelling?.abort();
    const { signal } = (this.labelling = new AbortController());
    this.setLabels(null);
    const found = await labels(this.client, source, signal).catch(() => null);
    if (found && !signal.aborted) this.setLabels(found);
  }

  private setLabels(labels: Labels | null): void {
    this.labels = labels;
    this.pin(null, false);
    this.hover(null);
    this.colour.disabled = !labels;
  }

  /** Pins the atom in the middle of the canvas. */
  pinMiddle(): void {
    this.pin(this.viewer.pick(0, 0)?.atom ?? null);
  }

  release(): void {
    this.pin(null);
  }

  private find(text: string): void {
    const atom = this.labels?.find(text);
    if (!atom) return this.tell([el("span", {}, text.trim() ? `There is no residue “${text.trim()}”.` : "Type a residue, such as A LYS 15.")]);
    this.pin(atom.row);
    if (!this.viewer.face(atom.first, atom.last)) $("picked").append(el("span", {}, " It does not contribute to the surface."));
  }

  /** Hovers in the next frame, since pointers move more often than frames are drawn. */
  private soon(place: { x: number; y: number }): void {
    if (this.viewer.triangles > MAX_HOVER_TRIANGLES || this.viewer.isTurning) return;
    const waiting = this.pending !== null;
    this.pending = place;
    if (waiting) return;
    requestAnimationFrame(() => {
      const at = this.pending;
      this.pending = null;
      if (at) this.hover(this.under(at.x, at.y), at);
    });
  }

  private under(x: number, y: number): number | null {
    const { clientWidth, clientHeight } = this.viewer.canvas;
    const hit = this.viewer.pick((2 * x) / clientWidth - 1, 1 - (2 * y) / clientHeight);
    return hit && hit.atom >= 0 ? hit.atom : null;
  }

  private hover(row: number | null, at?: { x: number; y: number }): void {
    if (row === null) {
      this.pending = null;
      show(this.tip, false);
      return this.viewer.mark("hovered", null);
    }
    const atom = this.labels?.of(row) ?? null;
    this.viewer.mark("hovered", atom ? [atom.first, atom.last] : [row, row]);
    this.tip.textContent = atom ? nameOf(atom) : `Atom ${row + 1}`;
    show(this.tip, true);
    if (!at) return;
    const left = Math.min(at.x + 14, this.viewer.canvas.clientWidth - this.tip.offsetWidth - 6);
    this.tip.style.transform = `translate(${Math.max(4, left)}px, ${Math.max(4, at.y - 34)}px)`;
  }

  private pin(row: number | null, aloud = true): void {
    const was = this.pinned;
    this.pinned = row;
    show($("unpin"), row !== null);
    if (row === null) {
      this.viewer.mark("pinned", null);
      if (was !== null || !aloud) this.tell([el("span", { class: "hint" }, "Point at the surface to see the atom. Click to pin it.")]);
      return;
    }
    const atom = this.labels?.of(row) ?? null;
    this.viewer.mark("pinned", atom ? [atom.first, atom.last] : [row, row]);
    this.tell(atom ? described(atom) : [el("strong", {}, `Atom ${row + 1} of the file`)]);
    if (aloud) this.announce(atom ? `Pinned ${nameOf(atom)}` : `Pinned atom ${row + 1}`);
  }

  private tell(nodes: Node[]): void {
    $("picked").replaceChildren(...nodes);
  }
}

function described(atom: Atom): Node[] {
  const residue = `${atom.residue} ${atom.number}${atom.insertion}`;
  return [
    el("strong", {}, `${residue} · ${atom.atom}`),
    el("span", {}, `chain ${atom.chain || "(blank)"}, ${atom.kind}, element ${atom.element}, atom ${atom.row + 1} of the file`),
  ];
}
