// Server-sent events over fetch, since a browser's own EventSource cannot send a token.

import { Refusal, answered, pause } from "./api.js";

const SILENT_MS = 40_000; // the server speaks at least every 15 s
const LONGEST_WAIT_MS = 10_000;

/**
 * Tell `listener(kind, data)` what happens at a path, until the signal ends it. A connection that breaks is made
 * again, and goes on after the last event that has an id. Ends with a Refusal where the server does not let it go on.
 */
export async function follow(path, listener, signal) {
  let last = "0-0", wait_ms = 500;
  while (!signal.aborted) {
    const connection = new AbortController();
    const end = () => connection.abort();
    signal.addEventListener("abort", end, { once: true });
    try {
      const answer = await answered(path, { headers: { "Last-Event-ID": last }, signal: connection.signal });
      for await (const event of events(answer.body, connection)) {
        wait_ms = 500;
        if (event.id) last = event.id;
        if (event.kind === "fault") throw new Refusal(event.data, 410);
        listener(event.kind, event.data);
      }
    } catch (error) {
      if (error instanceof Refusal) throw error;
      if (signal.aborted) return;
    } finally {
      signal.removeEventListener("abort", end);
      connection.abort();
    }
    await pause(wait_ms, signal).catch(() => {});
    wait_ms = Math.min(2 * wait_ms, LONGEST_WAIT_MS);
  }
}

async function* events(body, connection) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const timer = setTimeout(() => connection.abort(), SILENT_MS);
    const { value, done } = await reader.read().finally(() => clearTimeout(timer));
    if (done) return;
    text += value;
    const blocks = text.split("\n\n");
    text = blocks.pop();
    for (const block of blocks) {
      const event = parsed(block);
      if (event) yield event;
    }
  }
}

function parsed(block) {
  const fields = {};
  for (const line of block.split("\n")) {
    const at = line.indexOf(": ");
    if (at > 0) fields[line.slice(0, at)] = line.slice(at + 2);
  }
  return fields.event ? { kind: fields.event, id: fields.id, data: JSON.parse(fields.data) } : null;
}
