/**
 * Reads the bytes of a response. If their number is known, they are read directly into one buffer. This takes a third
 * less time than `arrayBuffer()`, whose time for a few megabytes is as long as meshing.
 */
export async function bytesOf(reply: Response): Promise<ArrayBuffer> {
  const length = Number(reply.headers.get("content-length"));
  if (!reply.body || !(length > 1 << 20)) return reply.arrayBuffer();
  let reader;
  try {
    reader = reply.body.getReader({ mode: "byob" });
  } catch {
    // Not every browser supports byte streams for responses.
    return reply.arrayBuffer();
  }
  let buffer = new ArrayBuffer(length);
  for (let at = 0; ; ) {
    if (at === buffer.byteLength) {
      // There are more bytes if a proxy compressed the response and stated the compressed length.
      const { value } = await reader.read(new Uint8Array(1 << 16));
      if (!value?.byteLength) return buffer;
      const larger = new Uint8Array(2 * at + value.byteLength);
      larger.set(new Uint8Array(buffer));
      larger.set(value, at);
      buffer = larger.buffer;
      at += value.byteLength;
      continue;
    }
    const { value, done } = await reader.read(new Uint8Array(buffer, at, buffer.byteLength - at));
    if (value) buffer = value.buffer as ArrayBuffer;
    if (done) return buffer.slice(0, at);
    at += value.byteLength;
  }
}
