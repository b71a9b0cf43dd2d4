/** Size and detail of a surface in tiles, as text. */

import type { TilesState } from "../scene/tiles";
import { bytes, number } from "./dom";

/** Writes the state of the tiles that are shown. */
export function showTiles(home: HTMLElement, { tiles, triangles, spacings: [finest, coarsest], bytes: memory, loading }: TilesState): void {
  const spacing = finest === coarsest ? `${number(finest, 2)} Å` : `${number(finest, 2)} to ${number(coarsest, 2)} Å`;
  const count = `${tiles} ${tiles === 1 ? "tile" : "tiles"}, ${triangles.toLocaleString("en")} triangles`;
  const text = `${count}, ${spacing}, ${bytes(memory)}${loading ? ", loading…" : ""}`;
  if (home.textContent !== text) home.textContent = text;
}
