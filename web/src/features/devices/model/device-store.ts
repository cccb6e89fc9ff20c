/** The state of one device: messages from the device and the cloud, with their arrival times. */
import type { Device, Lease } from "../../../shared/api/types";
import { MessageError } from "../../../shared/mqtt/checks";
import { RecentTelemetry } from "../../twin/model";
import { computed, signal, type ReadonlySignal, type Signal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { ApiError } from "../../../shared/api/http";
import { lateAfterMs } from "../../../shared/lib/arrivals";
import { clock, now, toPageClock } from "../../../shared/lib/clock";
import type { Link } from "../../../shared/mqtt/mqtt-link";
import { readAck, readDescription, readEvent, readMeasurements, readPresence, readState, readTelemetry, readTwin, type KnownAck, type KnownDescription, type KnownEvent, type KnownState, type KnownTelemetry, type KnownTwin } from "../../../shared/mqtt/parse-messages";
import { readFrame, type CameraFrame, type FrameKind } from "../../../shared/mqtt/camera-frame";
import type { Measurements, Presence } from "../../../shared/mqtt/protocol.generated";
import { deviceTopics, type DeviceTopics } from "../../../shared/mqtt/topics";

/** `unknown`: this page has no broker connection. */
export type Reach = "online" | "stale" | "offline" | "unknown";

/** On its own page, a device without telemetry for this long is stale [ms]. With the clock's period it is shown within a second. */
const STALE_MS = 700;
/** The list receives only `state`, every 30 s: two missed messages and a margin [ms]. */
const LIST_STALE_MS = 65_000;
const MAX_EVENTS = 20;

interface Timed<T> {
  message: T;
  /** On the page's clock [ms]. */
  receivedAt: number;
}

/** `receivedAt`: arrival time on the page's clock [ms]. */
type AckReceiver = (ack: KnownAck, receivedAt: number) => void;

/** The newest message of a stream; `everyMs`: time since the previous one, `null` for the first. */
interface MeasuredValues extends Timed<Measurements> {
  everyMs: number | null;
}

/** `account`: empty while only the device has reported the lease, because devices know names only. */
interface LeaseHolder {
  name: string;
  account: string;
  epoch: number;
  mine: boolean;
}

export interface OpenRequest {
  id: string;
  by: string;
  /** Id of the requester; empty until the cloud has stated it. */
  account: string;
  until: number;
}

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
  readonly #lastMessageAt = signal<number | null>(null);
  readonly #parseErrors = signal<ReadonlyMap<string, string>>(new Map());
  readonly #detailed = signal(false);
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
  /** The lease holder according to the cloud. The device's own report is in `state`. */
  readonly lease: ReadonlySignal<Lease | null>;
  /** The parse error of a topic's newest message; `null`: none. */
  readonly parseError = computed<string | null>(() => [...this.#parseErrors.value.values()].at(-1) ?? null);

  /** Time of the last message from the device, or from the cloud for it, on the page's clock [ms]. */
  readonly lastSeenAt = computed(() => {
    const at = this.#info.value.last_seen_at;
    const stored = at === null ? null : toPageClock(Date.parse(at));
    const received = this.#lastMessageAt.value;
    return stored === null || (received !== null && received > stored) ? received : stored;
  });

  /** Age of the newest telemetry [ms]; `null` before the first. */
  readonly telemetryAgeMs = computed(() => {
    // Sampled with the clock: at the arrival of a message it would always be 0.
    const at = clock.value;
    const latest = this.#telemetry.peek();
    return latest === null ? null : Math.max(0, at - latest.receivedAt);
  });

  readonly reach = computed<Reach>(() => {
    if (!this.#link.up.value) return "unknown";
    if (!(this.#presence.value?.online ?? this.#info.value.online)) return "offline";
    if (this.#detailed.value && (this.#description.value?.joints.length ?? 0) > 0) {
      const age = this.telemetryAgeMs.value;
      return age === null || age > STALE_MS ? "stale" : "online";
    }
    const lastSeenAt = this.lastSeenAt.value;
    return lastSeenAt === null || clock.value - lastSeenAt > LIST_STALE_MS ? "stale" : "online";
  });

  readonly #stop = computed(() => {
    const latest = this.#telemetry.value?.message;
    const state = this.#state.value;
    const newest = latest !== undefined && (state === null || latest.tick_ms >= state.tick_ms) ? latest : state;
    const mode = newest?.mode;
    if (mode === "stopped") return "applied";
    if (state === null || (state.stop ?? null) === null) return "none";
    // Newer telemetry in another mode may follow a reset. A device with a fault keeps the latch.
    if (newest !== state && mode !== "fault") return "none";
    if (mode !== "fault") return "pending";
    // The agent observes a robot that has stopped itself, and sends it no commands.
    const stoppedItself = state.faults.some(({ code }) => code.startsWith("driver."));
    return stoppedItself && this.live.value ? "applied" : "faulty";
  });

  /** Whether the displayed state is current. */
  readonly live = computed(() => this.reach.value === "online");

  /** The mode from the newest telemetry; `undefined` before the first. Changes less often than telemetry. */
  readonly mode = computed(() => this.#telemetry.value?.message.mode);

  /** Active restrictions of its motion, as the device reports them. */
  readonly limited = computed(() => this.#telemetry.value?.message.limited.join(", ") ?? "");

  /**
   * Whether the device has stopped, according to the newest message: its control loop has applied Stop, or it has stopped
   * itself and is observed. Another fault prevents both.
   */
  readonly stopped = computed(() => this.#stop.value === "applied");

  /** Whether Stop is latched, but the control loop has not applied it. */
  readonly stopPending = computed(() => this.#stop.value === "pending");

  /** Whether Stop is latched, but the device has a fault, so that it cannot confirm that it is at rest. */
  readonly stopFaulty = computed(() => this.#stop.value === "faulty");

  /**
   * The lease holder; `null`: none. The device enforces the lease that it has received, so its report takes precedence over the
   * cloud's, unless the cloud has a newer epoch.
   */
  readonly holder = computed<LeaseHolder | null>(() => {
    const lease = this.#lease.value;
    const reported = this.live.value ? this.#state.value : null;
    const current = lease !== null && toPageClock(Date.parse(lease.expires_at)) > clock.value ? lease : null;
    if (reported !== null && (current === null || current.epoch < reported.epoch)) {
      return reported.lease === null ? null : { name: reported.lease.holder, account: "", epoch: reported.epoch, mine: false };
    }
    return current === null ? null : { name: current.holder, account: current.holder_account, epoch: current.epoch, mine: current.mine };
  });

  /**
   * The open control request; `until`: on the page's clock. From the device if it reports the current lease, otherwise
   * from the cloud.
   */
  readonly request = computed<OpenRequest | null>(() => {
    const reported = this.#state.value?.lease ?? null;
    const lease = this.#lease.value;
    if (reported !== null && reported.epoch >= (lease?.epoch ?? 0)) {
      const { request } = reported;
      if (!request) return null;
      const account = lease?.request?.id === request.id ? lease.request.requester_account : "";
      return { id: request.id, by: request.requester, account, until: this.#stateAt + request.expires_in_ms };
    }
    const request = lease?.request ?? null;
    if (request === null) return null;
    return { id: request.id, by: request.requester, account: request.requester_account, until: toPageClock(Date.parse(request.expires_at)) };
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

  /** Applies the cloud's newest entry from the device list. */
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

  /** Subscribes to presence and state, for a list. Returns a function that unsubscribes. */
  watch(): () => void {
    return this.#subscribe({
      [this.topics.conn]: (payload, _, retained) => this.#applyPresence(readPresence(payload), retained),
      [this.topics.state]: (payload, _, retained) => {
        const state = readState(payload);
        this.#stateAt = retained ? Math.min(now(), toPageClock(state.at_ms)) : now();
        this.#state.value = state;
        this.#noteMessage(state.at_ms, retained);
      },
    });
  }

  /** Subscribes to all topics of the device's own page. Returns a function that unsubscribes. */
  watchDetails(): () => void {
    this.#detailed.value = true;
    const end = this.#subscribe({
      [this.topics.desc]: (payload, topic) => this.#applyDescription(payload, topic),
      [this.topics.twin]: (payload, topic) => {
        if (this.#isNew(topic, payload)) this.#twin.value = readTwin(payload);
      },
      [this.topics.tele]: (payload, topic) => {
        if (topic === this.topics.joints) this.#applyTelemetry(readTelemetry(payload));
        else this.#applyMeasurements(topic, readMeasurements(payload));
      },
      [this.topics.event]: (payload) => this.#applyEvent(readEvent(payload)),
      [this.topics.ack]: (payload) => this.#applyAck(readAck(payload)),
    });
    return () => {
      end();
      this.#detailed.value = false;
      this.#telemetry.value = null;
    };
  }

  /** The newest measurements of a stream, except `joints`; `null` before the first. */
  measured(stream: string): ReadonlySignal<MeasuredValues | null> {
    return this.#measuredOf(stream);
  }

  /** Whether a stream is older than three periods plus one second; uses the described or the observed period. */
  late(stream: string): boolean {
    const newest = this.#measuredOf(stream).value;
    if (newest === null || !this.#link.up.value) return true;
    const rate = this.#description.value?.streams.find((one) => one.name === stream)?.rate_hz ?? 1;
    return clock.value - newest.receivedAt > lateAfterMs(rate, newest.everyMs);
  }

  /** Subscribes to the description only. Returns a function that unsubscribes. */
  watchDescription(): () => void {
    return this.#subscribe({
      [this.topics.desc]: (payload, topic) => this.#applyDescription(payload, topic),
    });
  }

  /** Subscribes to the description and measurements, for a floor plan. Returns a function that unsubscribes. */
  watchMeasurements(): () => void {
    return this.#subscribe({
      [this.topics.desc]: (payload, topic) => this.#applyDescription(payload, topic),
      [this.topics.tele]: (payload, topic) => {
        if (topic !== this.topics.joints) this.#applyMeasurements(topic, readMeasurements(payload));
      },
    });
  }

  /** Subscribes to a stream of frames of one kind. Returns a function that unsubscribes. */
  watchFrames(name: string, kind: FrameKind, receiver: (frame: CameraFrame) => void): () => void {
    return this.#subscribe({
      [this.topics.cam(name)]: (payload) => {
        receiver(readFrame(payload, kind));
        this.#lastMessageAt.value = now();
      },
    });
  }

  /** Subscribes to the acks of one command, including those already received. Returns a function that unsubscribes. */
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
          this.#setParseError(topic, null);
        } catch (error) {
          if (!(error instanceof MessageError)) throw error;
          this.#setParseError(topic, error.message);
        }
      }),
    );
    return () => {
      for (const end of ends) end();
    };
  }

  #applyDescription(payload: Uint8Array, topic: string): void {
    if (this.#isNew(topic, payload)) this.#description.value = readDescription(payload);
  }

  /** A new connection delivers retained messages again: unchanged ones must not trigger a redraw. */
  #isNew(topic: string, payload: Uint8Array): boolean {
    const previous = this.#retained.get(topic);
    if (previous?.length === payload.length && previous.every((byte, index) => byte === payload[index])) return false;
    this.#retained.set(topic, payload);
    return true;
  }

  #setParseError(topic: string, error: string | null): void {
    const previous = this.#parseErrors.value;
    if ((previous.get(topic) ?? null) === error) return;
    const next = new Map(previous);
    if (error === null) next.delete(topic);
    else next.set(topic, error);
    this.#parseErrors.value = next;
  }

  #applyPresence(presence: Required<Presence>, retained: boolean): void {
    const previous = this.#presence.value;
    // The will of an older connection may arrive after messages of a newer one.
    if (previous !== null && presence.session < previous.session) return;
    this.#presence.value = presence;
    this.#noteMessage(presence.at_ms, retained);
  }

  #applyTelemetry(message: KnownTelemetry): void {
    const previous = this.#telemetry.value?.message;
    const expected = this.#description.value?.joints.length;
    if (expected !== undefined && message.position_rad.length !== expected) {
      throw new MessageError(`telemetry has ${message.position_rad.length} joints, the description ${expected}`);
    }
    // Older than the displayed message, unless the agent restarted with a new clock.
    if (previous !== undefined && message.tick_ms <= previous.tick_ms && message.at_ms <= previous.at_ms) return;
    const at = now();
    this.#telemetry.value = { message, receivedAt: at };
    this.#lastMessageAt.value = at;
    this.history.add(message, at);
  }

  #measuredOf(stream: string): Signal<MeasuredValues | null> {
    let values = this.#measured.get(stream);
    if (values === undefined) {
      values = signal(null);
      this.#measured.set(stream, values);
    }
    return values;
  }

  #applyMeasurements(topic: string, message: Measurements): void {
    const newest = this.#measuredOf(topic.slice(topic.lastIndexOf("/") + 1));
    const previous = newest.value;
    // A duplicate or out of order, unless the agent restarted.
    if (previous !== null && message.tick_ms <= previous.message.tick_ms && message.at_ms <= previous.message.at_ms) return;
    const at = now();
    newest.value = { message, receivedAt: at, everyMs: previous === null ? null : at - previous.receivedAt };
    this.#lastMessageAt.value = at;
  }

  #applyEvent(event: KnownEvent): void {
    if (this.#events.value.some((previous) => previous.id === event.id)) return;
    this.#events.value = [event, ...this.#events.value].slice(0, MAX_EVENTS);
  }

  #applyAck(ack: KnownAck): void {
    const previous = this.#recentAcks.get(ack.id) ?? [];
    const receivedAt = now();
    this.#recentAcks.set(ack.id, [...previous, { message: ack, receivedAt }]);
    for (const oldest of [...this.#recentAcks.keys()].slice(0, -MAX_EVENTS)) this.#recentAcks.delete(oldest);
    for (const receiver of this.#ackReceivers) receiver(ack, receivedAt);
  }

  /** A retained message is older than its arrival: use its own time, but never a future one. */
  #noteMessage(atMs: number, retained: boolean): void {
    const at = retained ? Math.min(now(), toPageClock(atMs)) : now();
    if (this.#lastMessageAt.value === null || at > this.#lastMessageAt.value) this.#lastMessageAt.value = at;
  }
}
