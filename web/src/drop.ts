/** Files dropped anywhere on the page. */

import { $, show } from "./ui/dom";

export function drops(take: (file: File) => void): void {
  const hint = $("drop-here");
  const holdsFiles = (event: DragEvent) => event.dataTransfer?.types.includes("Files") ?? false;
  window.addEventListener("dragover", (event) => {
    if (!holdsFiles(event)) return;
    event.preventDefault();
    show(hint, true);
  });
  window.addEventListener("dragleave", (event) => {
    if (event.relatedTarget === null) show(hint, false);
  });
  window.addEventListener("drop", (event) => {
    if (!holdsFiles(event)) return;
    event.preventDefault();
    show(hint, false);
    const file = event.dataTransfer?.files[0];
    if (file) take(file);
  });
}
