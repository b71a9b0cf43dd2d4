/** List of the parts of a surface, which shows and hides them. */

import type { Viewer } from "../scene/viewer";
import { el } from "./dom";

/** Lists the parts in `home`, or hides `home` if the surface is not divided. Calls `changed` after a change. */
export function listParts(home: HTMLElement, viewer: Viewer, changed: () => void): void {
  const names = viewer.partNames;
  home.hidden = names.length < 2;
  const shown = new Set(viewer.shownParts);
  const entries = home.hidden ? [] : names.map((name) => entry(name, shown.has(name), viewer, changed));
  home.replaceChildren(...entries);
}

function entry(name: string, shown: boolean, viewer: Viewer, changed: () => void): HTMLElement {
  const box = el("input", { type: "checkbox", checked: shown });
  box.addEventListener("change", () => {
    viewer.showPart(name, box.checked);
    changed();
  });
  return el("label", {}, box, name);
}
