/** Control of one device: acquires, renews and loses the lease, and owns its setpoint stream. */
import type { GrantedLease } from "../../../shared/api/types";
import type { DeviceStore, OpenRequest } from "../../devices/model";
import { RoundTrip } from "../../latency/model";
import { SetpointStreamer } from "../../steering/model";
import { batch, computed, effect, signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { ControlRequest } from "./control-request";
import { ApiError, sentence } from "../../../shared/api/http";
import { now } from "../../../shared/lib/clock";
import { sealed } from "../../../shared/mqtt/sealed-setpoint";
import { MqttLink, type LinkStatus, type SetpointLink, type SetpointTransport } from "../../../shared/mqtt/mqtt-link";
import { XmppLink } from "../../../shared/xmpp/xmpp-link";

export const LEASE_MS = 30_000;
const RETRY_MS = 1_000;

type ControlState =
  | { kind: "none" }
  | { kind: "taking" }
  | { kind: "held"; epoch: number; confirmed: boolean }
  /** `epoch`: the lease that ended. */
  | { kind: "lost"; epoch: number; reason: string }
  /** Handed over to the requester. */
  | { kind: "handed"; to: string }
  | { kind: "refused"; reason: string };

/** The holder's response to a control request. */
type ResponseState =
  | { kind: "none" }
  | { kind: "sending"; accept: boolean }
  | { kind: "kept"; from: string }
  | { kind: "failed"; reason: string };

/** Creates the setpoint connection. */
type OpenControlLink = (device: string, epoch: number, transport: SetpointTransport) => SetpointLink;

/** Opens a connection of the chosen transport. */
function controlLinks(api: Api): OpenControlLink {
  return (device, epoch, transport) => {
    const purpose = { purpose: "control", device, epoch } as const;
    return transport === "xmpp" ? new XmppLink(() => api.xmppCredentials(purpose)) : new MqttLink(() => api.credentials(purpose));
  };
}

export class Control {
  readonly #api: Api;
  readonly #device: DeviceStore;
  readonly #openLink: OpenControlLink;
  readonly #preferred: () => SetpointTransport;
  readonly #state = signal<ControlState>({ kind: "none" });
  readonly #streamer = signal<SetpointStreamer | null>(null);
  readonly #linkStatus = signal<LinkStatus | null>(null);
  readonly #transport = signal<SetpointTransport | null>(null);
  readonly roundTrip = new RoundTrip();
  #link: SetpointLink | null = null;
  #timer: ReturnType<typeof setTimeout> | undefined;
  #expiry: ReturnType<typeof setTimeout> | undefined;
  #cleanups: (() => void)[] = [];
  #epochReported = false;
  #setpointKey = "";
  /** The new operator during a handover. The end of this lease then does not count as a loss. */
  #handingTo: string | null = null;
  readonly #response = signal<ResponseState>({ kind: "none" });

  /** This session's request for control from another operator. */
  readonly outgoingRequest: ControlRequest;
  /** The response to another operator's request. */
  readonly response: ReadonlySignal<ResponseState> = this.#response;
  readonly state: ReadonlySignal<ControlState> = this.#state;
  /** Set while the lease is held. */
  readonly streamer: ReadonlySignal<SetpointStreamer | null> = this.#streamer;
  /** The connection for setpoints; `null` without a lease. */
  readonly linkStatus: ReadonlySignal<LinkStatus | null> = this.#linkStatus;
  /** What carries the setpoints; `null` without a lease. */
  readonly transport: ReadonlySignal<SetpointTransport | null> = this.#transport;

  /** `preferred`: what carries setpoints if the site offers it; read when control is taken. */
  constructor(api: Api, device: DeviceStore, openLink?: OpenControlLink, preferred: () => SetpointTransport = () => "mqtt") {
    this.#api = api;
    this.#device = device;
    this.#openLink = openLink ?? controlLinks(api);
    this.#preferred = preferred;
    // An accepted request transfers the lease to this session: only renew it.
    this.outgoingRequest = new ControlRequest(api, device, (epoch) => {
      void this.#acquire(() => api.renewLease(device.id, LEASE_MS, epoch));
    });
  }

  /** The open control request to this page. */
  readonly incomingRequest = computed<OpenRequest | null>(() =>
    this.#state.value.kind === "held" ? this.#device.request.value : null,
  );

  /** What will carry the setpoints of the next lease. A lease never changes its transport. */
  get nextTransport(): SetpointTransport {
    const preferred = this.#preferred();
    return this.#device.info.value.setpoints_over.includes(preferred) ? preferred : "mqtt";
  }

  get epoch(): number | null {
    return this.#state.value.kind === "held" ? this.#state.value.epoch : null;
  }

  async take(): Promise<void> {
    this.outgoingRequest.clear();
    await this.#acquire(() => this.#api.takeLease(this.#device.id, LEASE_MS));
  }

  /** Takes control from the current operator, who sees the reason. For owners. */
  async takeOver(reason: string): Promise<void> {
    this.outgoingRequest.clear();
    await this.#acquire(() => this.#api.takeOver(this.#device.id, LEASE_MS, reason));
  }

  /** Clears the outcome of a response or request. */
  dismiss(): void {
    this.outgoingRequest.clear();
    if (this.#response.value.kind !== "sending") this.#response.value = { kind: "none" };
    const { kind } = this.#state.value;
    if (kind === "handed" || kind === "lost" || kind === "refused") this.#state.value = { kind: "none" };
  }

  /** Hands control over to the requester, or rejects the request. */
  async respond(accept: boolean): Promise<void> {
    const request = this.incomingRequest.value;
    if (request === null || this.#response.value.kind === "sending") return;
    this.#response.value = { kind: "sending", accept };
    if (accept) this.#handingTo = request.by;
    try {
      await this.#api.respondToRequest(this.#device.id, request.id, accept);
      this.#response.value = accept ? { kind: "none" } : { kind: "kept", from: request.by };
      if (accept) this.#handedOver(request.by);
    } catch (error) {
      this.#response.value = { kind: "failed", reason: sentence(error) };
      void this.#device.refreshLease();
    } finally {
      this.#handingTo = null;
    }
  }

  async #acquire(grant: () => Promise<GrantedLease>): Promise<void> {
    if (this.#state.value.kind === "taking" || this.#state.value.kind === "held") return;
    this.#state.value = { kind: "taking" };
    const requestedAt = now();
    try {
      this.#acquired(await grant(), requestedAt);
    } catch (error) {
      this.#state.value = { kind: "refused", reason: sentence(error) };
      void this.#device.refreshLease();
    }
  }

  /** Releases control. `leaving`: the page closes, so the call must complete after it. */
  async release(leaving = false): Promise<void> {
    const { epoch } = this;
    if (epoch === null) return;
    this.#end({ kind: "none" });
    try {
      await this.#api.releaseLease(this.#device.id, epoch, leaving);
      this.#device.setLease(null);
    } catch (error) {
      // The lease expires soon; the page already stopped streaming.
      if (!(error instanceof ApiError && error.code === "lease-lost")) {
        this.#state.value = { kind: "lost", epoch, reason: sentence(error) };
      }
    }
  }

  /** Ends the streams because the page is hidden. */
  onHidden(): void {
    this.#streamer.value?.end("hidden");
  }

  /** Ends the streams because Stop was pressed. */
  onStop(): void {
    this.#streamer.value?.end("stopped");
  }

  dispose(): void {
    this.outgoingRequest.dispose();
    void this.release(true);
    this.#end({ kind: "none" });
  }

  #acquired(granted: GrantedLease, requestedAt: number): void {
    const { epoch } = granted;
    this.#epochReported = false;
    this.#response.value = { kind: "none" };
    this.#device.setLease({ holder: granted.holder, holder_account: "", epoch, expires_at: granted.expires_at, mine: true });
    this.roundTrip.restart();
    const link = granted.streaming ? this.#openLink(this.#device.id, epoch, this.nextTransport) : null;
    const topic = this.#device.topics.ctl(epoch);
    const streamer = new SetpointStreamer({
      epoch,
      joints: this.#device.description.value?.joints ?? [],
      send: (setpoint) =>
        link?.publish(topic, sealed(setpoint, this.#setpointKey, topic), 0) ?? Promise.reject(new Error("no setpoint connection")),
      telemetry: () => this.#device.telemetry.value,
    });
    this.#link = link;
    batch(() => {
      this.#streamer.value = streamer;
      this.#transport.value = link?.transport ?? null;
      this.#state.value = { kind: "held", epoch, confirmed: granted.confirmed };
    });
    this.#renewed(granted, requestedAt);
    this.#cleanups = [
      effect(() => {
        if (link === null) return;
        this.#linkStatus.value = link.status.value;
        if (link.status.value.state === "refused") this.#lose(link.status.value.reason);
      }),
      effect(() => this.#applyReports(epoch)),
    ];
  }

  /** Applies the robot's reported epoch: a higher epoch, or none after ours, ends the lease regardless of the local clock. */
  #applyReports(epoch: number): void {
    const latest = this.#device.telemetry.value;
    const state = this.#device.state.value;
    const reportedEpoch = Math.max(latest?.message.epoch ?? 0, state?.epoch ?? 0);
    queueMicrotask(() => {
      const current = this.#state.peek();
      if (current.kind !== "held" || current.epoch !== epoch) return;
      if (this.#handingTo !== null) {
        if (reportedEpoch > epoch) this.#handedOver(this.#handingTo);
        return;
      }
      if (reportedEpoch > epoch) {
        this.#lose("another operator has control");
        return;
      }
      if (latest?.message.epoch === epoch) {
        this.#epochReported = true;
        if (!current.confirmed) this.#state.value = { ...current, confirmed: true };
      } else if (this.#epochReported && latest?.message.epoch === 0) {
        this.#lose("the robot ended it");
        // This lease is unusable: release it, so that other operators can take the next one.
        void this.#api.releaseLease(this.#device.id, epoch, false).catch(() => undefined).then(() => this.#device.refreshLease());
        return;
      }
      this.#streamer.peek()?.follow();
      if (latest?.message.epoch === epoch && latest.message.setpoint_sequence > 0) {
        this.roundTrip.add(latest.message.setpoint_sequence, latest.message.setpoint_sent_ms, latest.receivedAt);
      }
    });
  }

  #renewed(granted: GrantedLease, requestedAt: number): void {
    this.#setpointKey = granted.setpoint_key;
    clearTimeout(this.#expiry);
    this.#expiry = setTimeout(
      () => this.#lose("it expired because the server could not be reached in time to renew it"),
      requestedAt + granted.lease_ms - now(),
    );
    this.#scheduleRenewal(granted.epoch, granted.lease_ms / 3);
  }

  #scheduleRenewal(epoch: number, delayMs: number): void {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => void this.#renew(epoch), delayMs);
  }

  async #renew(epoch: number): Promise<void> {
    if (this.epoch !== epoch) return;
    const requestedAt = now();
    try {
      const granted = await this.#api.renewLease(this.#device.id, LEASE_MS, epoch);
      if (this.epoch === epoch) this.#renewed(granted, requestedAt);
    } catch (error) {
      if (this.epoch !== epoch) return;
      if (error instanceof ApiError && error.status >= 400 && error.status < 500 && error.status !== 429) {
        this.#lose(sentence(error));
      } else {
        this.#scheduleRenewal(epoch, RETRY_MS);
      }
    }
  }

  #handedOver(to: string): void {
    if (this.epoch === null) return;
    this.#end({ kind: "handed", to });
    void this.#device.refreshLease();
  }

  #lose(reason: string): void {
    const { epoch } = this;
    if (epoch === null) return;
    this.#end({ kind: "lost", epoch, reason });
    void this.#device.refreshLease();
  }

  #end(next: ControlState): void {
    clearTimeout(this.#timer);
    clearTimeout(this.#expiry);
    for (const cleanup of this.#cleanups) cleanup();
    this.#cleanups = [];
    this.#streamer.value?.dispose();
    this.#link?.close();
    this.#link = null;
    this.outgoingRequest.clear();
    batch(() => {
      this.#streamer.value = null;
      this.#linkStatus.value = null;
      this.#transport.value = null;
      this.#state.value = next;
    });
  }
}
