/** Buttons, forms and menus of the page, apart from the parameters and the downloads. */

import { drops } from "./drop";
import { $, copy } from "./ui/dom";

/** Actions of the page. */
export interface Actions {
  openFile(file: File): void;
  /** Opens an entry of the archive. */
  openEntry(id: string): void;
  openSample(): void;
  /** Cancels the running request. */
  cancel(): void;
  /** Resets all parameters. */
  reset(): void;
  /** Divides the surface into chains, or joins it. */
  divide(byChain: boolean): void;
  /** Draws ligands as sticks, or removes them. */
  setSticks(on: boolean): void;
  /** Sets the transparency, per cent; `live` while its slider is dragged. */
  setTransparency(percent: number, live: boolean): void;
  /** Called when another format is chosen for the command line. */
  formatChanged(): void;
  /** Returns the address of the shown surface in the chosen format; empty if there is none. */
  address(): string;
  copied(): void;
  copyFailed(error: unknown): void;
}

export function connect(actions: Actions): void {
  const file = $<HTMLInputElement>("file");
  file.addEventListener("change", () => {
    const chosen = file.files?.[0];
    if (chosen) actions.openFile(chosen);
    file.value = "";
  });
  drops((dropped) => actions.openFile(dropped));
  $("pdb-form").addEventListener("submit", (event) => {
    event.preventDefault();
    const id = $<HTMLInputElement>("pdb").value.trim();
    if (id) actions.openEntry(id);
  });
  $("sample").addEventListener("click", () => actions.openSample());
  $("cancel").addEventListener("click", () => actions.cancel());
  $("reset-all").addEventListener("click", () => actions.reset());
  $("format").addEventListener("change", () => actions.formatChanged());
  const [byChain, sticks, transparency] = ["by-chain", "sticks", "transparency"].map((id) => $<HTMLInputElement>(id)) as [HTMLInputElement, HTMLInputElement, HTMLInputElement];
  byChain.addEventListener("change", () => actions.divide(byChain.checked));
  sticks.addEventListener("change", () => actions.setSticks(sticks.checked));
  for (const type of ["input", "change"]) transparency.addEventListener(type, () => actions.setTransparency(transparency.valueAsNumber, type === "input"));
  const copies = (id: string, text: () => string) =>
    $(id).addEventListener("click", () => void copy(text()).then(() => actions.copied(), (error: unknown) => actions.copyFailed(error)));
  copies("copy-curl", () => $("curl").textContent ?? "");
  copies("copy-url", () => actions.address());
}
