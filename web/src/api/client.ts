/** Requests to the service, with the key where one was given. */

import { problemOf } from "./problem";

export class Client {
  /** A key lives as long as the page does: it is written down nowhere. */
  key = "";

  /** Sends a request to a path of this service or to a full address. Throws every status but a success as a Problem. */
  async ask(path: string, options: RequestInit = {}): Promise<Response> {
    const headers = new Headers(options.headers);
    if (this.key) headers.set("authorization", `Bearer ${this.key}`);
    const reply = await fetch(path, { ...options, headers });
    if (!reply.ok) throw await problemOf(reply);
    return reply;
  }

  async json<T>(path: string, options: RequestInit = {}): Promise<T> {
    return (await (await this.ask(path, options)).json()) as T;
  }
}
