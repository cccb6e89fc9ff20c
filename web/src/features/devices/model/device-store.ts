/** One device as the page knows it: only what it or the cloud has said, with the time at which it was heard. */
import type { Device, Lease } from "../../../shared/api/types";
import { MessageError } from "../../../shared/mqtt/checks";
import { RecentTelemetry } from "../../twin/model";
import { computed, signal, type ReadonlySignal, type Signal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { ApiError } from "../../../shared/api/http";
import { clock, now, onThisClock } from "../../../shared/lib/clock";
import type { Link } from "../../../shared/mqtt/mqtt-link";
import { readAck, readDescription, readEvent, readMeasurements, readPresence, readState, readTelemetry, readTwin, type KnownAck, type KnownDescription, type KnownEvent, type KnownState, type KnownTelemetry, type KnownTwin } from "../../../shared/mqtt/parse-messages";
import { readFrame, type CameraFrame } from "../../../shared/mqtt/camera-frame";
import type { Measurements, Presence } from "../../../shared/mqtt/protocol.generated";
import { deviceTopics, type DeviceTopics } from "../../../shared/mqtt/topics";

/** `unknown`: this page has no connection of its own, so it cannot say. */
export type Reach = "online" | "stale" | "offline" | "unknown";

/** Watched closely, a device that has sent no telemetry for this long is stale [ms]. */
export const STALE_MS = 1_000;
/** In the list only `state` is heard, every 30 s: two of them missed, and a little [ms]. */
export const LIST_STALE_MS = 65_000;
const EVENTS_KEPT = 20;

export interface Timed<T> {
  message: T;
  /** On the page's clock [ms]. */
  receivedAt: number;
}

/** `receivedAt`: on the page's clock, when it came [ms]. */
export type AckReceiver = (ack: KnownAck, receivedAt: number) => void;

/** The newest of one stream; `everyMs`: how long after the one before it came, `null` for the first. */
export interface MeasuredValues extends Timed<Measurements> {
  everyMs: number | null;
}

export interface OpenRequestHere {
  id: string;
  by: string;
  until: number;
}

/** What is measured on its own page and comes this much later than it should is stale [ms]. */
const LATE_MS = 1_000;
const PERIODS = 3;

export class DeviceStore {
  readonly id: string;
  readonly topics: DeviceTopics;
  readonly history = new RecentTelemetry();
  readonly #api: Api;
  readonly #link: Link;
  readonly #info;
  readonly #presence = signal<Required<Presence> | null>(null);
  readonly #description = signal<KnownDescription | null>(null);
  readonly #twin = signal<KnownTwin | null>(null);
  readonly #state = signal<KnownState | null>(null);
  #stateAt = 0;
  readonly #telemetry = signal<Timed<KnownTelemetry> | null>(null);
  readonly #measured = new Map<string, Signal<MeasuredValues | null>>();
  readonly #events = signal<readonly KnownEvent[]>([]);
  readonly #lease;
  readonly #heardAt = signal<number | null>(null);
  readonly #troubles = signal<ReadonlyMap<string, string>>(new Map());
  readonly #close = signal(false);
  readonly #retained = new Map<string, Uint8Array>();
  readonly #ackReceivers = new Set<AckReceiver>();
  readonly #recentAcks = new Map<string, Timed<KnownAck>[]>();

  readonly info: ReadonlySignal<Device>;
  readonly presence: ReadonlySignal<Required<Presence> | null> = this.#presence;
  readonly description: ReadonlySignal<KnownDescription | null> = this.#description;
  readonly twin: ReadonlySignal<KnownTwin | null> = this.#twin;
  readonly state: ReadonlySignal<KnownState | null> = this.#state;
  readonly telemetry: ReadonlySignal<Timed<KnownTelemetry> | null> = this.#telemetry;
  readonly events: ReadonlySignal<readonly KnownEvent[]> = this.#events;
  /** Who the cloud says has control. The device's own word is in `state`. */
  readonly lease: ReadonlySignal<Lease | null>;
  /** Why the newest message of some topic could not be read; `null` when all could. */
  readonly trouble = computed<string | null>(() => [...this.#troubles.value.values()].at(-1) ?? null);

  /** When the device, or the cloud for it, last said anything, on the page's clock [ms]. */
  readonly lastSeenAt = computed(() => {
    const at = this.#info.value.last_seen_at;
    const told = at === null ? null : onThisClock(Date.parse(at));
    const heard = this.#heardAt.value;
    return told === null || (heard !== null && heard > told) ? heard : told;
  });

  /** Age of the newest telemetry [ms]; `null` before the first. */
  readonly telemetryAgeMs = computed(() => {
    // Sampled with the clock: asked at every message it would always be nought.
    const at = clock.value;
    const latest = this.#telemetry.peek();
    return latest === null ? null : Math.max(0, at - latest.receivedAt);
  });

  readonly reach = computed<Reach>(() => {
    if (!this.#link.up.value) return "unknown";
    if (!(this.#presence.value?.online ?? this.#info.value.online)) return "offline";
    if (this.#close.value && (this.#description.value?.joints.length ?? 0) > 0) {
      const age = this.telemetryAgeMs.value;
      return age === null || age > STALE_MS ? "stale" : "online";
    }
    const heardAt = this.lastSeenAt.value;
    return heardAt === null || clock.value - heardAt > LIST_STALE_MS ? "stale" : "online";
  });

  /** Whether what is shown of the device is what it is now. */
  readonly live = computed(() => this.reach.value === "online");

  /** What it does, by its newest telemetry; `undefined` before the first. Changes seldom, where telemetry does not. */
  readonly mode = computed(() => this.#telemetry.value?.message.mode);

  /** What makes its motion other than asked for, as it names it; empty where nothing does. */
  readonly limited = computed(() => this.#telemetry.value?.message.limited.join(", ") ?? "");

  /** Latched, by the newest word of the device. */
  readonly stopped = computed(() => {
    const latest = this.#telemetry.value?.message;
    const state = this.#state.value;
    const newest = latest !== undefined && (state === null || latest.tick_ms >= state.tick_ms) ? latest : state;
    return newest?.mode === "stopped" || (state?.stop ?? null) !== null && newest === state;
  });

  /**
   * The lease holder; `null`: none. The device enforces the lease it knows, so its report takes precedence over the
   * cloud's, unless the cloud has a newer epoch.
   */
  readonly holder = computed<{ name: string; mine: boolean } | null>(() => {
    const lease = this.#lease.value;
    const told = this.live.value ? this.#state.value : null;
    const current = lease !== null && onThisClock(Date.parse(lease.expires_at)) > clock.value ? lease : null;
    if (told !== null && (current === null || current.epoch < told.epoch)) {
      return told.lease === null ? null : { name: told.lease.holder, mine: false };
    }
    return current === null ? null : { name: current.holder, mine: current.mine };
  });

  /**
   * Who asks the holder for control; `until`: on the page's clock. By the word of the device where it shows the lease
   * that is in force, else by the cloud's.
   */
  readonly request = computed<OpenRequestHere | null>(() => {
    const told = this.#state.value?.lease ?? null;
    const lease = this.#lease.value;
    if (told !== null && told.epoch >= (lease?.epoch ?? 0)) {
      const { request } = told;
      return request ? { id: request.id, by: request.requester, until: this.#stateAt + request.expires_in_ms } : null;
    }
    const request = lease?.request ?? null;
    return request === null ? null : { id: request.id, by: request.requester, until: onThisClock(Date.parse(request.expires_at)) };
  });

  constructor(info: Device, api: Api, link: Link) {
    this.id = info.id;
    this.topics = deviceTopics(info.topic);
    this.#api = api;
    this.#link = link;
    this.#info = signal(info);
    this.#lease = signal(info.lease);
    this.info = this.#info;
    this.lease = this.#lease;
  }

  /** The cloud's newest word, from the list of devices. */
  update(info: Device): void {
    this.#info.value = info;
    this.#lease.value = info.lease;
  }

  setLease(lease: Lease | null): void {
    this.#lease.value = lease;
  }

  async refreshLease(): Promise<void> {
    try {
      this.#lease.value = await this.#api.lease(this.id);
    } catch (error) {
      if (!(error instanceof ApiError)) throw error;
    }
  }

  /** Hear presence and state: enough for a list. Returns what ends it. */
  watch(): () => void {
    return this.#subscribe({
      [this.topics.conn]: (payload, _, retained) => this.#hearPresence(readPresence(payload), retained),
      [this.topics.state]: (payload, _, retained) => {
        const state = readState(payload);
        this.#stateAt = retained ? Math.min(now(), onThisClock(state.at_ms)) : now();
        this.#state.value = state;
        this.#noteHeard(state.at_ms, retained);
      },
    });
  }

  /** Hear everything else too: what the device's own page shows. Returns what ends it. */
  watchClosely(): () => void {
    this.#close.value = true;
    const end = this.#subscribe({
      [this.topics.desc]: (payload, topic) => {
        if (this.#isNew(topic, payload)) this.#description.value = readDescription(payload);
      },
      [this.topics.twin]: (payload, topic) => {
        if (this.#isNew(topic, payload)) this.#twin.value = readTwin(payload);
      },
      [this.topics.tele]: (payload, topic) => {
        if (topic === this.topics.joints) this.#hearTelemetry(readTelemetry(payload));
        else this.#hearMeasurements(topic, readMeasurements(payload));
      },
      [this.topics.event]: (payload) => this.#hearEvent(readEvent(payload)),
      [this.topics.ack]: (payload) => this.#hearAck(readAck(payload)),
    });
    return () => {
      end();
      this.#close.value = false;
      this.#telemetry.value = null;
    };
  }

  /** The newest measurements of a stream other than the joints'; `null` before the first. */
  measured(stream: string): ReadonlySignal<MeasuredValues | null> {
    return this.#measuredOf(stream);
  }

  /** Whether a stream is older than three of its periods and a second: the description's period, or the one seen. */
  late(stream: string): boolean {
    const newest = this.#measuredOf(stream).value;
    if (newest === null || !this.#link.up.value) return true;
    const rate = this.#description.value?.streams.find((one) => one.name === stream)?.rate_hz ?? 1;
    const periodMs = Math.max(1000 / rate, newest.everyMs ?? 0);
    return clock.value - newest.receivedAt > LATE_MS + PERIODS * periodMs;
  }

  /** Hear what a device is, and no more: enough to offer what it has. Returns what ends it. */
  watchDescription(): () => void {
    return this.#subscribe({
      [this.topics.desc]: (payload, topic) => {
        if (this.#isNew(topic, payload)) this.#description.value = readDescription(payload);
      },
    });
  }

  /** Hear what a device is and what it measures: enough for a plan. Returns what ends it. */
  watchMeasurements(): () => void {
    return this.#subscribe({
      [this.topics.desc]: (payload, topic) => {
        if (this.#isNew(topic, payload)) this.#description.value = readDescription(payload);
      },
      [this.topics.tele]: (payload, topic) => {
        if (topic !== this.topics.joints) this.#hearMeasurements(topic, readMeasurements(payload));
      },
    });
  }

  /** Hear the pictures of a camera. Nothing is sent to this page before, or after what is returned is called. */
  watchCamera(name: string, receiver: (frame: CameraFrame) => void): () => void {
    return this.#subscribe({
      [this.topics.cam(name)]: (payload) => {
        receiver(readFrame(payload));
        this.#heardAt.value = now();
      },
    });
  }

  /** Hear the acks of one command, from the first that this page has seen. Returns what ends it. */
  onAck(id: string, receiver: AckReceiver): () => void {
    const mine: AckReceiver = (ack, receivedAt) => {
      if (ack.id === id) receiver(ack, receivedAt);
    };
    for (const { message, receivedAt } of this.#recentAcks.get(id) ?? []) receiver(message, receivedAt);
    this.#ackReceivers.add(mine);
    return () => this.#ackReceivers.delete(mine);
  }

  #subscribe(readers: Record<string, (payload: Uint8Array, topic: string, retained: boolean) => void>): () => void {
    const ends = Object.entries(readers).map(([filter, reader]) =>
      this.#link.subscribe(filter, (topic, payload, retained) => {
        try {
          reader(payload, topic, retained);
          this.#noteTrouble(topic, null);
        } catch (error) {
          if (!(error instanceof MessageError)) throw error;
          this.#noteTrouble(topic, error.message);
        }
      }),
    );
    return () => {
      for (const end of ends) end();
    };
  }

  /** Each new connection brings what is retained again: what is drawn from it must not be built again for that. */
  #isNew(topic: string, payload: Uint8Array): boolean {
    const known = this.#retained.get(topic);
    if (known?.length === payload.length && known.every((byte, index) => byte === payload[index])) return false;
    this.#retained.set(topic, payload);
    return true;
  }

  #noteTrouble(topic: string, what: string | null): void {
    const known = this.#troubles.value;
    if ((known.get(topic) ?? null) === what) return;
    const next = new Map(known);
    if (what === null) next.delete(topic);
    else next.set(topic, what);
    this.#troubles.value = next;
  }

  #hearPresence(presence: Required<Presence>, retained: boolean): void {
    const known = this.#presence.value;
    // The will of an older connection may come after the word of a newer one.
    if (known !== null && presence.session < known.session) return;
    this.#presence.value = presence;
    this.#noteHeard(presence.at_ms, retained);
  }

  #hearTelemetry(message: KnownTelemetry): void {
    const known = this.#telemetry.value?.message;
    const wanted = this.#description.value?.joints.length;
    if (wanted !== undefined && message.position_rad.length !== wanted) {
      throw new MessageError(`telemetry has ${message.position_rad.length} joints, the description ${wanted}`);
    }
    // Older than what is shown, unless the agent has started again and its clock with it.
    if (known !== undefined && message.tick_ms <= known.tick_ms && message.at_ms <= known.at_ms) return;
    const at = now();
    this.#telemetry.value = { message, receivedAt: at };
    this.#heardAt.value = at;
    this.history.add(message, at);
  }

  #measuredOf(stream: string): Signal<MeasuredValues | null> {
    let found = this.#measured.get(stream);
    if (found === undefined) {
      found = signal(null);
      this.#measured.set(stream, found);
    }
    return found;
  }

  #hearMeasurements(topic: string, message: Measurements): void {
    const newest = this.#measuredOf(topic.slice(topic.lastIndexOf("/") + 1));
    const known = newest.value;
    // The same twice, or out of order, unless the agent has started again.
    if (known !== null && message.tick_ms <= known.message.tick_ms && message.at_ms <= known.message.at_ms) return;
    const at = now();
    newest.value = { message, receivedAt: at, everyMs: known === null ? null : at - known.receivedAt };
    this.#heardAt.value = at;
  }

  #hearEvent(event: KnownEvent): void {
    if (this.#events.value.some((known) => known.id === event.id)) return;
    this.#events.value = [event, ...this.#events.value].slice(0, EVENTS_KEPT);
  }

  #hearAck(ack: KnownAck): void {
    const known = this.#recentAcks.get(ack.id) ?? [];
    const receivedAt = now();
    this.#recentAcks.set(ack.id, [...known, { message: ack, receivedAt }]);
    for (const oldest of [...this.#recentAcks.keys()].slice(0, -EVENTS_KEPT)) this.#recentAcks.delete(oldest);
    for (const receiver of this.#ackReceivers) receiver(ack, receivedAt);
  }

  /** A retained message was said some time ago: its own time counts, never a later one than now. */
  #noteHeard(atMs: number, retained: boolean): void {
    const at = retained ? Math.min(now(), onThisClock(atMs)) : now();
    if (this.#heardAt.value === null || at > this.#heardAt.value) this.#heardAt.value = at;
  }
}
