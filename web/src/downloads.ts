/** Downloads of the shown surface in every format, identical to the response of the API. */

import type { JobDocument } from "../client/dist/api";
import type { Client } from "../client/src/client";
import type { Source } from "./api/structures";
import { stem, surface, UNCACHED } from "./request";
import type { Choices } from "./rules";
import { $, bytes, el } from "./ui/dom";

export class Downloads {
  constructor(
    private readonly client: Client,
    formats: string[],
    private readonly file: (format: string) => { source: Source; choices: Choices } | null,
    private readonly failed: (error: unknown) => void,
  ) {
    const buttons = formats.map((format) => {
      const button = el("button", { type: "button", "data-format": format, "aria-label": `Download as ${format.toUpperCase()}` }, format);
      button.addEventListener("click", () => void this.save(format, button));
      return button;
    });
    $("formats").replaceChildren(...buttons);
  }

  private async save(format: string, button: HTMLButtonElement): Promise<void> {
    const file = this.file(format);
    if (!file) return;
    const status = $("saved");
    button.disabled = true;
    status.textContent = `Making the ${format.toUpperCase()}…`;
    try {
      const path = surface(file.source, format, file.choices);
      const onProgress = ({ fraction }: JobDocument) => (status.textContent = `Making the ${format.toUpperCase()}: ${Math.round(100 * fraction)} %`);
      const reply = await this.client.file(path, { onProgress, init: UNCACHED });
      const blob = await reply.blob();
      const name = /filename="([^"]+)"/.exec(reply.headers.get("content-disposition") ?? "")?.[1] ?? `${stem(file.source)}.${format}`;
      const url = URL.createObjectURL(blob);
      const link = el("a", { href: url, download: name });
      link.click();
      // The browser has saved the file by then.
      setTimeout(() => URL.revokeObjectURL(url), 60_000);
      status.textContent = `${name}, ${bytes(blob.size)}`;
    } catch (error) {
      status.textContent = "";
      this.failed(error);
    } finally {
      button.disabled = false;
    }
  }
}
