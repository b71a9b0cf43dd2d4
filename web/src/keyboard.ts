/** Keyboard control of the surface. */

import type { Picker } from "./picker";
import type { Viewer } from "./scene/viewer";

/** Rotation per key press, radians. */
const STEP = Math.PI / 18;

export function keyboard(home: HTMLElement, viewer: Viewer, picker: Picker): void {
  const keys: Record<string, () => void> = {
    ArrowLeft: () => viewer.move(-STEP, 0),
    ArrowRight: () => viewer.move(STEP, 0),
    ArrowUp: () => viewer.move(0, -STEP),
    ArrowDown: () => viewer.move(0, STEP),
    "+": () => viewer.move(0, 0, 1.15),
    "=": () => viewer.move(0, 0, 1.15),
    "-": () => viewer.move(0, 0, 1 / 1.15),
    Home: () => viewer.reset(),
    Enter: () => picker.pinMiddle(),
    Escape: () => picker.release(),
  };
  home.addEventListener("keydown", (event) => {
    const key = keys[event.key];
    if (!key || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    key();
  });
}
