/** List of the parts of a surface, which shows and hides them. */

import { el } from "./dom";

/** Lists the parts in `home`, or hides `home` if the surface is not divided. Calls `changed` with the parts to hide. */
export function listParts(home: HTMLElement, names: readonly string[], hidden: readonly string[], changed: (hidden: string[]) => void): void {
  home.hidden = names.length < 2;
  const boxes = home.querySelectorAll("input");
  const isSame = !home.hidden && boxes.length === names.length && names.every((name, i) => boxes[i]?.value === name);
  // A box that has the focus keeps it.
  if (isSame) return boxes.forEach((box) => (box.checked = !hidden.includes(box.value)));
  home.replaceChildren(...(home.hidden ? [] : names).map((name) => {
    const box = el("input", { type: "checkbox", value: name, checked: !hidden.includes(name) });
    return el("label", {}, box, name);
  }));
  home.onchange = () => changed([...home.querySelectorAll("input")].filter((box) => !box.checked).map((box) => box.value));
}
