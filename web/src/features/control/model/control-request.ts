/** A request for control, sent to the current operator of a device, and its outcome. */
import type { ControlRequestInfo } from "../../../shared/api/types";
import type { DeviceStore } from "../../devices/model";
import { effect, signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { now, toPageClock } from "../../../shared/lib/clock";
import { ApiError, sentence } from "../../../shared/api/http";

/** Time for the holder to respond [ms]. */
const ANSWER_WITHIN_MS = 30_000;
const LOOK_MS = 1_000;
/** Grace time after the deadline before the request counts as expired [ms]. */
const AFTER_MS = 5_000;

export type Ended = Exclude<ControlRequestInfo["outcome"], "open">;

export type ControlRequestState =
  | { kind: "none" }
  | { kind: "sending" }
  /** `until`: on the page's clock. `shown`: the device publishes the request, so the holder sees it immediately. */
  | { kind: "open"; id: string; epoch: number; until: number; shown: boolean; of: string }
  | { kind: "over"; how: Ended; of: string }
  | { kind: "failed"; why: string };

export class ControlRequest {
  readonly #api: Api;
  readonly #device: DeviceStore;
  readonly #accepted: (epoch: number) => void;
  readonly #state = signal<ControlRequestState>({ kind: "none" });
  #timer: ReturnType<typeof setTimeout> | undefined;
  readonly #forget: () => void;
  #disposed = false;

  readonly state: ReadonlySignal<ControlRequestState> = this.#state;

  /** `accepted` is called with the epoch that was handed over to this session. */
  constructor(api: Api, device: DeviceStore, accepted: (epoch: number) => void) {
    this.#api = api;
    this.#device = device;
    this.#accepted = accepted;
    // The device reports a new epoch, or the end of the request, before the next poll.
    this.#forget = effect(() => {
      const told = device.state.value?.lease ?? null;
      const asked = this.#state.peek();
      if (asked.kind === "open" && asked.shown && told?.request?.id !== asked.id) this.#lookIn(0);
    });
  }

  async ask(): Promise<void> {
    if (this.#state.value.kind === "sending" || this.#state.value.kind === "open") return;
    const of = this.#device.holder.value?.name ?? "";
    this.#state.value = { kind: "sending" };
    try {
      const { request, confirmed } = await this.#api.requestControl(this.#device.id, ANSWER_WITHIN_MS);
      if (this.#disposed) {
        this.#takeBack(request.id);
        return;
      }
      const until = toPageClock(Date.parse(request.expires_at));
      this.#state.value = { kind: "open", id: request.id, epoch: request.epoch, until, shown: confirmed, of };
      this.#lookIn(LOOK_MS);
    } catch (error) {
      this.#state.value = { kind: "failed", why: sentence(error) };
      void this.#device.refreshLease();
    }
  }

  /** Withdraws the request. If it was accepted at the same moment, this session keeps control until released. */
  async withdraw(): Promise<void> {
    const asked = this.#state.value;
    if (asked.kind !== "open") return;
    clearTimeout(this.#timer);
    try {
      await this.#api.withdrawRequest(this.#device.id, asked.id);
      this.#end({ kind: "over", how: "withdrawn", of: asked.of });
    } catch {
      this.#lookIn(0);
    }
  }

  /** Clears the outcome. */
  clear(): void {
    const { kind } = this.#state.value;
    if (kind === "over" || kind === "failed") this.#state.value = { kind: "none" };
  }

  dispose(): void {
    this.#disposed = true;
    const asked = this.#state.value;
    this.#end({ kind: "none" });
    this.#forget();
    if (asked.kind === "open") this.#takeBack(asked.id);
  }

  /** The page closes: the call completes after it. */
  #takeBack(id: string): void {
    void this.#api.withdrawRequest(this.#device.id, id, true).catch(() => undefined);
  }

  #end(state: ControlRequestState): void {
    clearTimeout(this.#timer);
    this.#state.value = state;
  }

  #lookIn(inMs: number): void {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => void this.#look(), inMs);
  }

  async #look(): Promise<void> {
    const asked = this.#state.value;
    if (asked.kind !== "open") return;
    let outcome: ControlRequestInfo["outcome"];
    try {
      outcome = (await this.#api.controlRequest(this.#device.id, asked.id)).outcome;
    } catch (error) {
      // A newer request replaced it: only the end of its lease is known.
      const gone = error instanceof ApiError && error.status === 404;
      outcome = gone ? "ended" : now() > asked.until + AFTER_MS ? "expired" : "open";
    }
    if (this.#state.value !== asked) return;
    if (outcome === "open") {
      this.#lookIn(LOOK_MS);
      return;
    }
    this.#end({ kind: "over", how: outcome, of: asked.of });
    if (outcome === "accepted") this.#accepted(asked.epoch + 1);
    else void this.#device.refreshLease();
  }
}
