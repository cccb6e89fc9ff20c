/** A broker connection in memory: the test delivers messages and reads what was published. */
import { computed, signal } from "@preact/signals-core";
import type { Link, LinkState, LinkStatus, Receiver, SetpointTransport } from "../../src/shared/mqtt/mqtt-link";
import { matches } from "../../src/shared/mqtt/topics";

export class FakeLink implements Link {
  transport: SetpointTransport = "mqtt";
  readonly #receivers = new Set<[filter: string, receiver: Receiver]>();
  readonly status = signal<LinkStatus>({ state: "up", reason: "" });
  readonly up = computed(() => this.status.value.state === "up");
  readonly published: { topic: string; message: object }[] = [];
  pings = 0;

  subscribe(filter: string, receiver: Receiver): () => void {
    const entry: [string, Receiver] = [filter, receiver];
    this.#receivers.add(entry);
    return () => this.#receivers.delete(entry);
  }

  publish(topic: string, message: object): Promise<void> {
    if (!this.up.value) return Promise.reject(new Error("no connection"));
    this.published.push({ topic, message });
    return Promise.resolve();
  }

  ping(): Promise<void> {
    this.pings += 1;
    return Promise.resolve();
  }

  renew(): void {
    this.set("up");
  }

  close(): void {
    this.set("closed");
  }

  set(state: LinkState): void {
    this.status.value = { state, reason: "" };
  }

  /** The filters of all subscriptions. */
  filters(): string[] {
    return [...this.#receivers].map(([filter]) => filter);
  }

  deliver(topic: string, message: object | string): void {
    const text = typeof message === "string" ? message : JSON.stringify(message);
    const payload = message instanceof Uint8Array ? message : new TextEncoder().encode(text);
    for (const [filter, receiver] of this.#receivers) if (matches(filter, topic)) receiver(topic, payload, false);
  }
}
