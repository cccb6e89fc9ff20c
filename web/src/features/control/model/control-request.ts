/** A request for control, sent to the current operator of a device, and its outcome. */
import type { ControlRequestInfo } from "../../../shared/api/types";
import type { DeviceStore } from "../../devices/model";
import { effect, signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { now, toPageClock } from "../../../shared/lib/clock";
import { ApiError, sentence } from "../../../shared/api/http";

/** Time for the holder to respond [ms]. */
const RESPONSE_TIMEOUT_MS = 30_000;
const POLL_MS = 1_000;
/** Grace time after the deadline before the request counts as expired [ms]. */
const GRACE_MS = 5_000;

export type RequestOutcome = Exclude<ControlRequestInfo["outcome"], "open">;

export type ControlRequestState =
  | { kind: "none" }
  | { kind: "sending" }
  /** `until`: on the page's clock. `published`: the device publishes the request, so the holder sees it immediately. */
  | { kind: "open"; id: string; epoch: number; until: number; published: boolean; holder: string }
  | { kind: "ended"; outcome: RequestOutcome; holder: string }
  | { kind: "failed"; reason: string };

export class ControlRequest {
  readonly #api: Api;
  readonly #device: DeviceStore;
  readonly #onAccepted: (epoch: number) => void;
  readonly #state = signal<ControlRequestState>({ kind: "none" });
  #timer: ReturnType<typeof setTimeout> | undefined;
  readonly #unsubscribe: () => void;
  #disposed = false;

  readonly state: ReadonlySignal<ControlRequestState> = this.#state;

  /** `accepted` is called with the epoch that was handed over to this session. */
  constructor(api: Api, device: DeviceStore, onAccepted: (epoch: number) => void) {
    this.#api = api;
    this.#device = device;
    this.#onAccepted = onAccepted;
    // The device reports a new epoch, or the end of the request, before the next poll.
    this.#unsubscribe = effect(() => {
      const lease = device.state.value?.lease ?? null;
      const current = this.#state.peek();
      if (current.kind === "open" && current.published && lease?.request?.id !== current.id) this.#pollIn(0);
    });
  }

  async send(): Promise<void> {
    if (this.#state.value.kind === "sending" || this.#state.value.kind === "open") return;
    const holder = this.#device.holder.value?.name ?? "";
    this.#state.value = { kind: "sending" };
    try {
      const { request, confirmed } = await this.#api.requestControl(this.#device.id, RESPONSE_TIMEOUT_MS);
      if (this.#disposed) {
        this.#withdrawAfterClose(request.id);
        return;
      }
      const until = toPageClock(Date.parse(request.expires_at));
      this.#state.value = { kind: "open", id: request.id, epoch: request.epoch, until, published: confirmed, holder };
      this.#pollIn(POLL_MS);
    } catch (error) {
      this.#state.value = { kind: "failed", reason: sentence(error) };
      void this.#device.refreshLease();
    }
  }

  /** Withdraws the request. If it was accepted at the same moment, this session keeps control until released. */
  async withdraw(): Promise<void> {
    const open = this.#state.value;
    if (open.kind !== "open") return;
    clearTimeout(this.#timer);
    try {
      await this.#api.withdrawRequest(this.#device.id, open.id);
      this.#end({ kind: "ended", outcome: "withdrawn", holder: open.holder });
    } catch {
      this.#pollIn(0);
    }
  }

  /** Clears the outcome. */
  clear(): void {
    const { kind } = this.#state.value;
    if (kind === "ended" || kind === "failed") this.#state.value = { kind: "none" };
  }

  dispose(): void {
    this.#disposed = true;
    const open = this.#state.value;
    this.#end({ kind: "none" });
    this.#unsubscribe();
    if (open.kind === "open") this.#withdrawAfterClose(open.id);
  }

  /** Withdraws a request after `dispose`. The call completes even if the page closes. */
  #withdrawAfterClose(id: string): void {
    void this.#api.withdrawRequest(this.#device.id, id, true).catch(() => undefined);
  }

  #end(state: ControlRequestState): void {
    clearTimeout(this.#timer);
    this.#state.value = state;
  }

  #pollIn(delayMs: number): void {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => void this.#poll(), delayMs);
  }

  async #poll(): Promise<void> {
    const open = this.#state.value;
    if (open.kind !== "open") return;
    let outcome: ControlRequestInfo["outcome"];
    try {
      outcome = (await this.#api.controlRequest(this.#device.id, open.id)).outcome;
    } catch (error) {
      // A newer request replaced it: only the end of its lease is known.
      const replaced = error instanceof ApiError && error.status === 404;
      outcome = replaced ? "ended" : now() > open.until + GRACE_MS ? "expired" : "open";
    }
    if (this.#state.value !== open) return;
    if (outcome === "open") {
      this.#pollIn(POLL_MS);
      return;
    }
    this.#end({ kind: "ended", outcome, holder: open.holder });
    if (outcome === "accepted") this.#onAccepted(open.epoch + 1);
    else void this.#device.refreshLease();
  }
}
