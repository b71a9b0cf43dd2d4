/** Requests to the service, with the API key if there is one. */

import { problemOf } from "./problem";

export class Client {
  /** API key, held in memory only. */
  key = "";

  /** Sends a request to a path of this service or to a full URL. Throws a Problem unless the status is a success. */
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
