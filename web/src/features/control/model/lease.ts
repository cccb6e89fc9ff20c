/** Control of one device: acquires, renews and loses the lease, and owns its setpoint stream. */
import type { GrantedLease } from "../../../shared/api/types";
import type { DeviceStore, OpenRequestHere } from "../../devices/model";
import { RoundTrip } from "../../latency/model";
import { SetpointStreamer } from "../../steering/model";
import { batch, computed, effect, signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { ControlRequest } from "./control-request";
import { ApiError, sentence } from "../../../shared/api/http";
import { now } from "../../../shared/lib/clock";
import { MqttLink, type Link, type LinkStatus } from "../../../shared/mqtt/mqtt-link";

export const LEASE_MS = 30_000;
const RETRY_MS = 1_000;

type ControlState =
  | { kind: "none" }
  | { kind: "taking" }
  | { kind: "held"; epoch: number; confirmed: boolean }
  | { kind: "lost"; why: string }
  /** Handed over to the requester. */
  | { kind: "handed"; to: string }
  | { kind: "refused"; why: string };

/** The holder's response to a control request. */
type AnswerState =
  | { kind: "none" }
  | { kind: "sending"; accept: boolean }
  | { kind: "kept"; from: string }
  | { kind: "failed"; why: string };

/** Creates the setpoint connection. */
type OpenControlLink = (device: string, epoch: number) => Link;

export class Control {
  readonly #api: Api;
  readonly #device: DeviceStore;
  readonly #openLink: OpenControlLink;
  readonly #state = signal<ControlState>({ kind: "none" });
  readonly #streamer = signal<SetpointStreamer | null>(null);
  readonly #linkStatus = signal<LinkStatus | null>(null);
  readonly roundTrip = new RoundTrip();
  #link: Link | null = null;
  #timer: ReturnType<typeof setTimeout> | undefined;
  #expiry: ReturnType<typeof setTimeout> | undefined;
  #cleanups: (() => void)[] = [];
  #obeyed = false;
  /** The new operator during a handover, whose lease end is not a loss. */
  #handingTo: string | null = null;
  readonly #answer = signal<AnswerState>({ kind: "none" });

  /** This session's request for control from another operator. */
  readonly asking: ControlRequest;
  /** The response to another operator's request. */
  readonly answered: ReadonlySignal<AnswerState> = this.#answer;
  readonly state: ReadonlySignal<ControlState> = this.#state;
  /** Set while the lease is held. */
  readonly streamer: ReadonlySignal<SetpointStreamer | null> = this.#streamer;
  /** The connection for setpoints; `null` without a lease. */
  readonly linkStatus: ReadonlySignal<LinkStatus | null> = this.#linkStatus;

  constructor(api: Api, device: DeviceStore, openLink?: OpenControlLink) {
    this.#api = api;
    this.#device = device;
    this.#openLink =
      openLink ?? ((id, epoch) => new MqttLink(() => api.credentials({ purpose: "control", device: id, epoch })));
    // The accepted lease already belongs to this session: only renew it.
    this.asking = new ControlRequest(api, device, (epoch) => {
      void this.#begin(() => api.renewLease(device.id, LEASE_MS, epoch));
    });
  }

  /** The open control request to this page. */
  readonly asked = computed<OpenRequestHere | null>(() =>
    this.#state.value.kind === "held" ? this.#device.request.value : null,
  );

  get epoch(): number | null {
    return this.#state.value.kind === "held" ? this.#state.value.epoch : null;
  }

  async take(): Promise<void> {
    this.asking.clear();
    await this.#begin(() => this.#api.takeLease(this.#device.id, LEASE_MS));
  }

  /** Takes control from the current operator, who sees the reason. For owners. */
  async takeOver(reason: string): Promise<void> {
    this.asking.clear();
    await this.#begin(() => this.#api.takeOver(this.#device.id, LEASE_MS, reason));
  }

  /** Clears the outcome of a response or request. */
  read(): void {
    this.asking.clear();
    if (this.#answer.value.kind !== "sending") this.#answer.value = { kind: "none" };
    const { kind } = this.#state.value;
    if (kind === "handed" || kind === "lost" || kind === "refused") this.#state.value = { kind: "none" };
  }

  /** Hands control over to the requester, or rejects the request. */
  async answer(accept: boolean): Promise<void> {
    const asked = this.asked.value;
    if (asked === null || this.#answer.value.kind === "sending") return;
    this.#answer.value = { kind: "sending", accept };
    if (accept) this.#handingTo = asked.by;
    try {
      await this.#api.respondToRequest(this.#device.id, asked.id, accept);
      this.#answer.value = accept ? { kind: "none" } : { kind: "kept", from: asked.by };
      if (accept) this.#handed(asked.by);
    } catch (error) {
      this.#answer.value = { kind: "failed", why: sentence(error) };
      void this.#device.refreshLease();
    } finally {
      this.#handingTo = null;
    }
  }

  async #begin(grant: () => Promise<GrantedLease>): Promise<void> {
    if (this.#state.value.kind === "taking" || this.#state.value.kind === "held") return;
    this.#state.value = { kind: "taking" };
    const askedAt = now();
    try {
      this.#hold(await grant(), askedAt);
    } catch (error) {
      this.#state.value = { kind: "refused", why: sentence(error) };
      void this.#device.refreshLease();
    }
  }

  /** Releases control. `leaving`: the page closes, so the call must complete after it. */
  async release(leaving = false): Promise<void> {
    const { epoch } = this;
    if (epoch === null) return;
    this.#letGo({ kind: "none" });
    try {
      await this.#api.releaseLease(this.#device.id, epoch, leaving);
      this.#device.setLease(null);
    } catch (error) {
      // The lease expires soon; the page already stopped streaming.
      if (!(error instanceof ApiError && error.code === "lease-lost")) {
        this.#state.value = { kind: "lost", why: sentence(error) };
      }
    }
  }

  /** The page is hidden: its streams must end. */
  hidden(): void {
    this.#streamer.value?.end("hidden");
  }

  /** Stop was pressed: ends all streams. */
  stopped(): void {
    this.#streamer.value?.end("stopped");
  }

  dispose(): void {
    this.asking.dispose();
    void this.release(true);
    this.#letGo({ kind: "none" });
  }

  #hold(granted: GrantedLease, askedAt: number): void {
    const { epoch } = granted;
    this.#obeyed = false;
    this.#answer.value = { kind: "none" };
    this.#device.setLease({ holder: granted.holder, epoch, expires_at: granted.expires_at, mine: true });
    this.roundTrip.restart();
    const link = this.#openLink(this.#device.id, epoch);
    const topic = this.#device.topics.ctl(epoch);
    const streamer = new SetpointStreamer({
      epoch,
      joints: this.#device.description.value?.joints ?? [],
      send: (setpoint) => link.publish(topic, setpoint, 0),
      telemetry: () => this.#device.telemetry.value,
    });
    this.#link = link;
    batch(() => {
      this.#streamer.value = streamer;
      this.#state.value = { kind: "held", epoch, confirmed: granted.confirmed };
    });
    this.#renewed(granted, askedAt);
    this.#cleanups = [
      effect(() => {
        this.#linkStatus.value = link.status.value;
        if (link.status.value.state === "refused") this.#lose(link.status.value.reason);
      }),
      effect(() => this.#hear(epoch)),
    ];
  }

  /** Applies the robot's reported epoch: a higher epoch, or none after ours, ends the lease regardless of the local clock. */
  #hear(epoch: number): void {
    const latest = this.#device.telemetry.value;
    const state = this.#device.state.value;
    const heard = Math.max(latest?.message.epoch ?? 0, state?.epoch ?? 0);
    queueMicrotask(() => {
      const current = this.#state.peek();
      if (current.kind !== "held" || current.epoch !== epoch) return;
      if (this.#handingTo !== null) {
        if (heard > epoch) this.#handed(this.#handingTo);
        return;
      }
      if (heard > epoch) {
        this.#lose("Another operator has control now.");
        return;
      }
      if (latest?.message.epoch === epoch) {
        this.#obeyed = true;
        if (!current.confirmed) this.#state.value = { ...current, confirmed: true };
      } else if (this.#obeyed && latest?.message.epoch === 0) {
        this.#lose("The robot has ended it: it was stopped, or had to hold. Take control again to go on.");
        // This lease is unusable: release it, so that other operators can take the next one.
        void this.#api.releaseLease(this.#device.id, epoch, false).catch(() => undefined).then(() => this.#device.refreshLease());
        return;
      }
      this.#streamer.peek()?.follow();
      if (latest?.message.epoch === epoch && latest.message.setpoint_sequence > 0) {
        this.roundTrip.seen(latest.message.setpoint_sequence, latest.message.setpoint_sent_ms, latest.receivedAt);
      }
    });
  }

  #renewed(granted: GrantedLease, askedAt: number): void {
    clearTimeout(this.#expiry);
    this.#expiry = setTimeout(
      () => this.#lose("Control ran out: the server could not be reached in time to renew it."),
      askedAt + granted.lease_ms - now(),
    );
    this.#plan(granted.epoch, granted.lease_ms / 3);
  }

  #plan(epoch: number, inMs: number): void {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => void this.#renew(epoch), inMs);
  }

  async #renew(epoch: number): Promise<void> {
    if (this.epoch !== epoch) return;
    const askedAt = now();
    try {
      const granted = await this.#api.renewLease(this.#device.id, LEASE_MS, epoch);
      if (this.epoch === epoch) this.#renewed(granted, askedAt);
    } catch (error) {
      if (this.epoch !== epoch) return;
      if (error instanceof ApiError && error.status >= 400 && error.status < 500 && error.status !== 429) {
        this.#lose(sentence(error));
      } else {
        this.#plan(epoch, RETRY_MS);
      }
    }
  }

  #handed(to: string): void {
    if (this.epoch === null) return;
    this.#letGo({ kind: "handed", to });
    void this.#device.refreshLease();
  }

  #lose(why: string): void {
    if (this.epoch === null) return;
    this.#letGo({ kind: "lost", why });
    void this.#device.refreshLease();
  }

  #letGo(next: ControlState): void {
    clearTimeout(this.#timer);
    clearTimeout(this.#expiry);
    for (const cleanup of this.#cleanups) cleanup();
    this.#cleanups = [];
    this.#streamer.value?.dispose();
    this.#link?.close();
    this.#link = null;
    this.asking.clear();
    batch(() => {
      this.#streamer.value = null;
      this.#linkStatus.value = null;
      this.#state.value = next;
    });
  }
}
