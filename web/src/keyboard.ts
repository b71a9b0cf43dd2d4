/** Keyboard control of the surface, on the page and in the component. */

import type { Viewer } from "./scene/viewer";

/** Rotation per key press, radians. */
const STEP = Math.PI / 18;
/** Rotation to the right and downwards, and magnification. */
const MOVES: Record<string, [number, number, number]> = {
  ArrowLeft: [-STEP, 0, 1], ArrowRight: [STEP, 0, 1], ArrowUp: [0, -STEP, 1], ArrowDown: [0, STEP, 1],
  "+": [0, 0, 1.15], "=": [0, 0, 1.15], "-": [0, 0, 1 / 1.15],
};

/** Moves the view with the keys pressed in `home`, and runs the actions of `more`. */
export function keyboard(home: HTMLElement, viewer: () => Viewer | null, more: Record<string, () => void> = {}): void {
  home.addEventListener("keydown", (event) => {
    const move = MOVES[event.key];
    const act = more[event.key] ?? (move && (() => viewer()?.move(...move)));
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
  });
}
