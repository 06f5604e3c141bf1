// What is asked of the server, with the token of this tab.

/** The server refuses: a sentence with the remedy. */
export class Refusal extends Error {
  constructor(sentence, status) {
    super(sentence);
    this.status = status;
  }
}

/** The server does not answer. */
export class Unreachable extends Error {
  constructor() {
    super("The server does not answer. What is shown is the last that was known; this page goes on asking.");
  }
}

const KEPT = "t6gps-token";
const PATIENCE_MS = 60_000;
const TEXT_OR_NUMBER = /"(?:[^"\\]|\\.)*"|-?\d[\d.eE+-]*/g;
const BUSY = new Set([429, 503]);
let needToken = null;
const listeners = new Set();
let reachable = true;

/** Who asks for a token: a function of the reason, whose promise ends when there is one. */
export function tokensFrom(ask) {
  needToken = ask;
}

export function keepToken(text) {
  sessionStorage.setItem(KEPT, text);
}

/** Be told whenever the server begins or ceases to answer. */
export function onReachable(listener) {
  listeners.add(listener);
}

function tell(now) {
  if (now === reachable) return;
  reachable = now;
  for (const listener of listeners) listener(now);
}

/** Whether the server takes a token: null, or why not. */
export async function tried(text) {
  const strange = /[^!-~]/u.exec(text)?.[0];
  if (strange) return `No token has the character “${strange}”. Copy the token again, whole and alone.`;
  try {
    const answer = await fetch("/v1/jobs", { headers: { Authorization: `Bearer ${text}` }, cache: "no-store" });
    return answer.status === 401 || answer.status === 429 ? (await answer.json()).error : null;
  } catch {
    return new Unreachable().message;
  }
}

/** An answer that is no refusal. Asks for a token where one is needed, and waits a while for a server that is busy. */
export async function answered(path, { method = "GET", body, headers = {}, signal } = {}) {
  const until = performance.now() + PATIENCE_MS;
  for (;;) {
    const token = sessionStorage.getItem(KEPT);
    if (!token) {
      await needToken("");
      continue;
    }
    const answer = await sent(path, method, body, { ...headers, Authorization: `Bearer ${token}` }, signal);
    if (answer.ok) return answer;
    if (answer.status === 401) {
      const reason = await sentence(answer);
      if (sessionStorage.getItem(KEPT) === token) await needToken(reason);
      continue;
    }
    const wait_s = Number(answer.headers.get("Retry-After"));
    if (BUSY.has(answer.status) && wait_s && performance.now() + 1000 * wait_s < until) {
      await pause(1000 * wait_s, signal);
      continue;
    }
    throw new Refusal(await sentence(answer), answer.status);
  }
}

async function sent(path, method, body, headers, signal) {
  const said = body === undefined ? {} : { body: JSON.stringify(body), headers: { ...headers, "Content-Type": "application/json" } };
  try {
    const answer = await fetch(path, { method, headers, signal, cache: "no-store", ...said });
    tell(true);
    return answer;
  } catch (error) {
    if (error.name === "AbortError") throw error;
    tell(false);
    throw new Unreachable();
  }
}

async function sentence(answer) {
  const text = await answer.text();
  try {
    return JSON.parse(text).error;
  } catch {
    return `The server answered ${answer.status}: ${text.slice(0, 200)}`;
  }
}

/** Wait; ends with an error when the signal says so. */
export function pause(ms, signal) {
  return new Promise((done, failed) => {
    const leave = () => (clearTimeout(timer), failed(new DOMException("left", "AbortError")));
    const timer = setTimeout(() => (signal?.removeEventListener("abort", leave), done()), ms);
    signal?.addEventListener("abort", leave, { once: true });
  });
}

export const get = async (path, signal) => (await answered(path, { signal })).json();
export const post = async (path, body) => (await answered(path, { method: "POST", body })).json();
export const run = (name) => `/v1/runs/${encodeURIComponent(name)}`;

let asking = Promise.resolve();

/**
 * The result of a SELECT over runs, as the answer, in a form of the server; its warnings are in the header. One is
 * asked after the other: of one token, a server answers two at a time, and there may be another tab.
 */
export function query(runs, sql, { form = "json", parameters = {}, signal } = {}) {
  const mine = asking.then(() => {
    signal?.throwIfAborted();
    return answered("/v1/query", { method: "POST", body: { runs, sql, form, parameters }, signal });
  });
  asking = mine.catch(() => {}); // who asked is told
  return mine;
}

/** The rows of such a result. */
export async function rows(runs, sql, parameters = {}, signal) {
  return exactly(await (await query(runs, sql, { parameters, signal })).text());
}

/** The values of a JSON text, where integers that a number cannot hold are texts of their digits. */
export function exactly(text) {
  return JSON.parse(text.replace(TEXT_OR_NUMBER, (found) => (/^-?\d{16,}$/.test(found) && !Number.isSafeInteger(Number(found)) ? `"${found}"` : found)));
}

/** A part of the page, which is read when it is needed: `reading` imports it. */
export async function part(reading) {
  try {
    return await reading();
  } catch (error) {
    if (error instanceof TypeError) throw new Error("The server does not answer, so that this part of the page could not be read. Try it again when the server is back.");
    throw error;
  }
}

/** Do something again and again while the tab is seen, until the signal ends it. */
export async function repeatedly(ms, doing, signal) {
  while (!signal.aborted) {
    if (!document.hidden) await doing();
    await pause(ms, signal).catch(() => {});
  }
}
