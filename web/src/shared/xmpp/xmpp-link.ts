/**
 * A connection for setpoints over XMPP that reconnects automatically, like `MqttLink`. It renews its access token before
 * it expires, and replaces its stream before the server ends it.
 */
import type { XmppCredentials } from "../api/types";
import { signal, type ReadonlySignal } from "@preact/signals-core";
import { isRefusal, sentence } from "../api/http";
import { now } from "../lib/clock";
import { refreshDelayMs, retryDelayMs } from "../lib/reconnect";
import type { LinkStatus, SetpointLink } from "../mqtt/mqtt-link";
import { XmppStream } from "./xmpp-stream";

const NO_CONNECTION = "There is no connection to the XMPP server.";
/** The server ends each stream after an hour [ms]. */
const REPLACE_AFTER_MS = 30 * 60_000;

export class XmppLink implements SetpointLink {
  readonly #fetchCredentials: () => Promise<XmppCredentials>;
  readonly #replaceAfterMs: number;
  readonly #status = signal<LinkStatus>({ state: "connecting", reason: "" });
  readonly #closing = new AbortController();
  #current: XmppStream | null = null;
  #refreshing = false;
  #attempts = 0;
  #timer: ReturnType<typeof setTimeout> | undefined;

  readonly transport = "xmpp";
  readonly status: ReadonlySignal<LinkStatus> = this.#status;

  constructor(fetchCredentials: () => Promise<XmppCredentials>, replaceAfterMs = REPLACE_AFTER_MS) {
    this.#fetchCredentials = fetchCredentials;
    this.#replaceAfterMs = replaceAfterMs;
    void this.#refresh();
  }

  async publish(topic: string, message: object): Promise<void> {
    if (this.#current === null) throw new Error(NO_CONNECTION);
    await this.#current.publish(topic, JSON.stringify(message));
  }

  close(): void {
    this.#closing.abort();
    clearTimeout(this.#timer);
    this.#drop();
    this.#status.value = { state: "closed", reason: "" };
  }

  get #closed(): boolean {
    return this.#closing.signal.aborted;
  }

  /** Renews the token of the stream, or opens a stream and replaces the current one, if any. */
  async #refresh(): Promise<void> {
    if (this.#current === null) this.#status.value = { ...this.#status.value, state: "connecting" };
    this.#refreshing = true;
    try {
      const obtainedAt = now();
      const credentials = await this.#fetchCredentials();
      const current = this.#current;
      if (current !== null && now() - current.openedAt < this.#replaceAfterMs) {
        await current.signIn(credentials.token);
      } else {
        const next = await XmppStream.open(credentials, this.#closing.signal, (stream, reason) => this.#lost(stream, reason));
        this.#drop();
        this.#current = next;
      }
      this.#attempts = 0;
      this.#status.value = { state: "up", reason: "" };
      this.#schedule(refreshDelayMs(credentials.lifetime_s, now() - obtainedAt));
    } catch (error) {
      this.#failed(error);
    } finally {
      this.#refreshing = false;
    }
  }

  #lost(stream: XmppStream, reason: string): void {
    if (this.#current !== stream || this.#closed) return;
    this.#current = null;
    this.#status.value = { state: "down", reason };
    if (!this.#refreshing) this.#retry();
  }

  #failed(error: unknown): void {
    if (this.#closed) return;
    if (isRefusal(error)) {
      this.#drop();
      this.#status.value = { state: "refused", reason: sentence(error) };
      return;
    }
    if (this.#current === null) this.#status.value = { state: "down", reason: sentence(error) };
    this.#retry();
  }

  #retry(): void {
    this.#schedule(retryDelayMs(this.#attempts));
    this.#attempts += 1;
  }

  #schedule(delayMs: number): void {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => void this.#refresh(), delayMs);
  }

  #drop(): void {
    const stream = this.#current;
    this.#current = null;
    stream?.close();
  }
}
