/**
 * A broker connection that reconnects automatically. It fetches short-lived credentials, replaces them before they
 * expire without losing messages, and uses new ones after a connection loss.
 */
import type { Credentials } from "../api/types";
import { computed, signal, type ReadonlySignal } from "@preact/signals-core";
import type { MqttClient } from "mqtt";
import { isRefusal, sentence } from "../api/http";
import { now } from "../lib/clock";
import { refreshDelayMs, retryDelayMs } from "../lib/reconnect";
import { matches } from "./topics";

export type LinkState = "connecting" | "up" | "down" | "refused" | "closed";

export interface LinkStatus {
  state: LinkState;
  /** Why the connection is down or was rejected, or "". */
  reason: string;
}

/** `retained`: the message was published before this page subscribed. */
export type Receiver = (topic: string, payload: Uint8Array, retained: boolean) => void;

/** What carries setpoints. */
export type SetpointTransport = "mqtt" | "xmpp";

/** The connection for setpoints. */
export interface SetpointLink {
  readonly transport: SetpointTransport;
  readonly status: ReadonlySignal<LinkStatus>;
  /** Publishes now or fails; messages are never queued. Resolves when sent (QoS 0) or acknowledged (QoS 1). */
  publish(topic: string, message: object, qos: 0 | 1): Promise<void>;
  close(): void;
}

/** The connection interface that the models use. */
export interface Link extends SetpointLink {
  readonly up: ReadonlySignal<boolean>;
  /** Subscribes to a topic or filter; returns a function that unsubscribes. */
  subscribe(filter: string, receiver: Receiver): () => void;
  /** Pings the broker; resolves with its response. */
  ping(): Promise<void>;
  /** Reconnects with new credentials, which include newly visible devices. */
  renew(): void;
}

/** Maximum filters per SUBSCRIBE at Event Grid and AWS IoT Core. */
const FILTERS_PER_SUBSCRIBE = 8;
const KEEPALIVE_S = 60;
const PING_AFTER_SILENCE_MS = 5_000;
const DEAD_AFTER_SILENCE_MS = 12_000;
const CONNECT_TIMEOUT_MS = 8_000;
const NO_CONNECTION = "There is no connection to the broker.";

interface Connection {
  client: MqttClient;
  credentials: Credentials;
  obtainedAt: number;
  lastPacketAt: number;
  retired: boolean;
  /** Number of unanswered pings; the broker responds in order. */
  pings: number;
}

export class MqttLink implements Link {
  readonly #fetchCredentials: () => Promise<Credentials>;
  readonly #status = signal<LinkStatus>({ state: "connecting", reason: "" });
  readonly #receivers = new Map<string, Set<Receiver>>();
  readonly #wildcards = new Set<string>();
  /** Topic → matching filters, cached per topic. Cleared when filters change. */
  readonly #filtersByTopic = new Map<string, readonly string[]>();
  #current: Connection | null = null;
  #opening = false;
  #reopen = false;
  #attempts = 0;
  #timer: ReturnType<typeof setTimeout> | undefined;
  readonly #aliveTimer: ReturnType<typeof setInterval>;
  readonly #pendingFilters = new Set<string>();
  readonly #closing = new AbortController();

  readonly transport = "mqtt";
  readonly status: ReadonlySignal<LinkStatus> = this.#status;
  readonly up = computed(() => this.#status.value.state === "up");

  constructor(fetchCredentials: () => Promise<Credentials>) {
    this.#fetchCredentials = fetchCredentials;
    this.#aliveTimer = setInterval(() => this.#checkAlive(), PING_AFTER_SILENCE_MS);
    void this.#open();
  }

  subscribe(filter: string, receiver: Receiver): () => void {
    const receivers = this.#receivers.get(filter) ?? new Set();
    receivers.add(receiver);
    this.#receivers.set(filter, receivers);
    if (isWildcard(filter)) this.#wildcards.add(filter);
    this.#filtersByTopic.clear();
    if (receivers.size === 1) this.#subscribeSoon(filter);
    return () => {
      receivers.delete(receiver);
      if (receivers.size > 0 || this.#receivers.get(filter) !== receivers) return;
      this.#receivers.delete(filter);
      this.#wildcards.delete(filter);
      this.#filtersByTopic.clear();
      this.#pendingFilters.delete(filter);
      const client = this.#current?.client;
      if (client?.connected) client.unsubscribe(filter, () => undefined);
    };
  }

  publish(topic: string, message: object, qos: 0 | 1): Promise<void> {
    const client = this.#current?.client;
    if (!client?.connected) return Promise.reject(new Error(NO_CONNECTION));
    return new Promise((resolve, reject) => {
      client.publish(topic, JSON.stringify(message), { qos }, (error) => {
        if (error) reject(error);
        else resolve();
      });
    });
  }

  ping(): Promise<void> {
    const connection = this.#current;
    if (!connection?.client.connected) return Promise.reject(new Error(NO_CONNECTION));
    const { client } = connection;
    return new Promise((resolve, reject) => {
      let earlierPings = connection.pings;
      const settle = (): void => {
        clearTimeout(timer);
        client.off("packetreceive", onPacket);
        client.off("close", fail);
      };
      const onPacket = ({ cmd }: { cmd: string }): void => {
        if (cmd !== "pingresp") return;
        earlierPings -= 1;
        if (earlierPings >= 0) return;
        settle();
        resolve();
      };
      const fail = (): void => {
        settle();
        reject(new Error("The broker did not respond."));
      };
      const timer = setTimeout(fail, CONNECT_TIMEOUT_MS);
      client.on("packetreceive", onPacket);
      client.on("close", fail);
      client.sendPing();
    });
  }

  renew(): void {
    void this.#open();
  }

  close(): void {
    this.#closing.abort();
    clearTimeout(this.#timer);
    clearInterval(this.#aliveTimer);
    this.#receivers.clear();
    this.#wildcards.clear();
    this.#drop();
    this.#status.value = { state: "closed", reason: "" };
  }

  /** Opens a new connection and replaces the current one, if any. */
  async #open(): Promise<void> {
    if (this.#closed) return;
    if (this.#opening) {
      this.#reopen = true;
      return;
    }
    this.#opening = true;
    clearTimeout(this.#timer);
    if (this.#current === null) this.#status.value = { ...this.#status.value, state: "connecting" };
    try {
      const obtainedAt = now();
      const credentials = await this.#fetchCredentials();
      const client = await connect(credentials, this.#closing.signal);
      await this.#adopt({ client, credentials, obtainedAt, lastPacketAt: now(), retired: false, pings: 0 });
    } catch (error) {
      this.#failed(error);
    } finally {
      this.#opening = false;
    }
    if (this.#reopen) {
      this.#reopen = false;
      void this.#open();
    }
  }

  get #closed(): boolean {
    return this.#closing.signal.aborted;
  }

  async #adopt(next: Connection): Promise<void> {
    const { client, credentials } = next;
    client.on("message", (topic, payload, packet) => {
      next.lastPacketAt = now();
      // Both connections may deliver briefly: receivers accept duplicate messages.
      if (!next.retired) this.#deliver(topic, payload, packet.retain);
    });
    client.on("packetreceive", ({ cmd }) => {
      next.lastPacketAt = now();
      if (cmd === "pingresp") next.pings -= 1;
    });
    client.on("packetsend", ({ cmd }) => {
      if (cmd === "pingreq") next.pings += 1;
    });
    client.on("close", () => this.#lost(next));
    client.on("error", () => undefined); // The 'close' event that follows is handled.
    const previous = this.#current;
    this.#current = next;
    this.#pendingFilters.clear();
    await subscribeAll(client, [...this.#receivers.keys()]);
    if (previous !== null) retire(previous);
    if (!client.connected) throw new Error("The broker closed the connection.");
    this.#attempts = 0;
    this.#status.value = { state: "up", reason: "" };
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => void this.#open(), refreshDelayMs(credentials.lifetime_s, now() - next.obtainedAt));
  }

  #lost(connection: Connection): void {
    if (this.#current !== connection || this.#closed) return;
    this.#drop();
    this.#status.value = { state: "down", reason: "The connection to the broker was lost." };
    if (!this.#opening) this.#retry();
  }

  #failed(error: unknown): void {
    if (this.#closed) return;
    if (isRefusal(error)) {
      this.#drop();
      this.#status.value = { state: "refused", reason: sentence(error) };
      return;
    }
    if (this.#current === null || !this.#current.client.connected) {
      this.#drop();
      this.#status.value = { state: "down", reason: sentence(error) };
    }
    this.#retry();
  }

  #retry(): void {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => void this.#open(), retryDelayMs(this.#attempts));
    this.#attempts += 1;
  }

  #drop(): void {
    const connection = this.#current;
    this.#current = null;
    if (connection !== null) retire(connection);
  }

  #deliver(topic: string, payload: Uint8Array, retained: boolean): void {
    let filters = this.#filtersByTopic.get(topic);
    if (filters === undefined) {
      filters = [topic, ...[...this.#wildcards].filter((filter) => matches(filter, topic))];
      this.#filtersByTopic.set(topic, filters);
    }
    for (const filter of filters) this.#receivers.get(filter)?.forEach((receiver) => receiver(topic, payload, retained));
  }

  /** Sends the subscriptions of one event-loop turn together, in as few packets as the limit permits. */
  #subscribeSoon(filter: string): void {
    if (this.#pendingFilters.size === 0) {
      queueMicrotask(() => {
        const filters = [...this.#pendingFilters];
        this.#pendingFilters.clear();
        const client = this.#current?.client;
        if (client?.connected) subscribeAll(client, filters).catch(() => undefined); // After a connection loss all filters are subscribed again.
      });
    }
    this.#pendingFilters.add(filter);
  }

  /** Detects a dead connection before the broker's keep-alive does. */
  #checkAlive(): void {
    const connection = this.#current;
    if (!connection?.client.connected) return;
    const silenceMs = now() - connection.lastPacketAt;
    if (silenceMs > DEAD_AFTER_SILENCE_MS && silenceMs < 4 * DEAD_AFTER_SILENCE_MS) {
      this.#lost(connection);
    } else if (silenceMs > PING_AFTER_SILENCE_MS / 2) {
      // After a suspended page, silence is no evidence: ping first.
      if (silenceMs >= 4 * DEAD_AFTER_SILENCE_MS) connection.lastPacketAt = now();
      connection.client.sendPing();
    }
  }
}

function isWildcard(filter: string): boolean {
  return filter.includes("+") || filter.endsWith("#");
}

function retire(connection: Connection): void {
  connection.retired = true;
  connection.client.end(true);
}

async function connect(credentials: Credentials, closing: AbortSignal): Promise<MqttClient> {
  const { default: mqtt } = await import("mqtt");
  closing.throwIfAborted();
  return new Promise((resolve, reject) => {
    const client = mqtt.connect(credentials.websocket_url, {
      protocolVersion: 4,
      clean: true,
      clientId: credentials.client_id,
      username: credentials.username,
      password: credentials.password,
      keepalive: KEEPALIVE_S,
      connectTimeout: CONNECT_TIMEOUT_MS,
      // Credentials expire, so this class reconnects with new ones.
      reconnectPeriod: 0,
      resubscribe: false,
      queueQoSZero: false,
      // The library's worker timers use a blob URL, which the content security policy forbids.
      timerVariant: "native",
    });
    const settle = (): void => {
      client.off("error", failed);
      client.off("close", unreachable);
      closing.removeEventListener("abort", unreachable);
    };
    const failed = (error: Error): void => {
      settle();
      client.on("error", () => undefined); // Ignore errors after the end.
      client.end(true);
      reject(error);
    };
    const unreachable = (): void => {
      failed(new Error("The broker cannot be reached."));
    };
    client.once("connect", () => {
      settle();
      resolve(client);
    });
    client.on("error", failed);
    client.on("close", unreachable);
    closing.addEventListener("abort", unreachable);
  });
}

async function subscribeAll(client: MqttClient, filters: readonly string[]): Promise<void> {
  for (let start = 0; start < filters.length; start += FILTERS_PER_SUBSCRIBE) {
    const batch = filters.slice(start, start + FILTERS_PER_SUBSCRIBE);
    // QoS 1 is the maximum: telemetry is still delivered at its published QoS 0.
    await new Promise<void>((resolve, reject) => {
      const failed = (): void => {
        clearTimeout(timer);
        client.off("close", failed);
        reject(new Error("The broker did not respond."));
      };
      const timer = setTimeout(failed, CONNECT_TIMEOUT_MS);
      client.once("close", failed);
      client.subscribe(batch, { qos: 1 }, () => {
        // A rejected filter does not affect the others; its data is shown as unknown.
        clearTimeout(timer);
        client.off("close", failed);
        if (client.connected) resolve();
        else failed();
      });
    });
  }
}
