/** Stop: sent to the robot over all channels repeatedly, until the robot confirms that it has stopped. */
import type { DeviceStore } from "../../devices/model";
import { computed, effect, signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { sentence } from "../../../shared/api/http";
import { now } from "../../../shared/lib/clock";
import { newId } from "../../../shared/lib/ids";
import type { Link } from "../../../shared/mqtt/mqtt-link";
import type { KnownState } from "../../../shared/mqtt/parse-messages";
import type { Stop } from "../../../shared/mqtt/protocol.generated";

const REPEAT_MS = 200;
/** Without confirmation for this long, the page shows a prominent warning [ms]. */
const CONFIRM_TIMEOUT_MS = 1_000;
/** Stop is republished for at most this long; after it, an operator must be at the robot [ms]. */
const REPEAT_FOR_MS = 60_000;

/**
 * `sending`: sent less than `CONFIRM_TIMEOUT_MS` ago. `sent`: not confirmed. `unreachable`: the agent is offline, or no
 * channel could send it. `fault`: latched, but the robot has a fault and confirms nothing. `latched`: the control loop of the robot has applied it.
 */
export type StopKind = "clear" | "sending" | "sent" | "unreachable" | "fault" | "latched";

interface StopState {
  kind: StopKind;
  /** Whether Stop is still republished. */
  repeating: boolean;
}

interface Pressed {
  /** `latched`: the robot confirmed to the cloud; this page has not received the state yet. */
  kind: Exclude<StopKind, "clear" | "fault">;
  at: number;
  repeating: boolean;
}

export class StopSwitch {
  readonly #api: Api;
  readonly #device: DeviceStore;
  readonly #link: Link;
  readonly #author: string;
  readonly #pressed = signal<Pressed | null>(null);
  readonly #resetting = signal(false);
  readonly #error = signal<string | null>(null);
  readonly #disposeEffects: readonly (() => void)[];
  #timer: ReturnType<typeof setInterval> | undefined;
  #stateAtPress: KnownState | null = null;

  readonly resetting: ReadonlySignal<boolean> = this.#resetting;
  /** The error of the last stop or reset, or `null`. */
  readonly error: ReadonlySignal<string | null> = this.#error;

  readonly state = computed<StopState>(() => {
    const pressed = this.#pressed.value;
    if (pressed?.repeating === true) return { kind: pressed.kind, repeating: true };
    if (this.#device.stopped.value) return { kind: "latched", repeating: false };
    if (pressed !== null) return { kind: pressed.kind, repeating: false };
    const kind = this.#device.stopFaulty.value ? "fault" : this.#device.stopPending.value ? "sent" : "clear";
    return { kind, repeating: false };
  });

  constructor(api: Api, device: DeviceStore, link: Link, author: string) {
    this.#api = api;
    this.#device = device;
    this.#link = link;
    this.#author = author;
    let wasClear = true;
    const clearError = effect(() => {
      const clear = !device.stopped.value && !device.stopPending.value && !device.stopFaulty.value;
      // An error of the reset is no longer true once the robot reports that it is not stopped.
      if (clear && !wasClear) queueMicrotask(() => (this.#error.value = null));
      wasClear = clear;
    });
    const confirm = effect(() => {
      const latest = device.telemetry.value;
      const pressed = this.#pressed.value;
      // The robot's own state takes precedence once it arrives.
      if (pressed?.kind === "latched" && latest !== null && latest.receivedAt > pressed.at + CONFIRM_TIMEOUT_MS) {
        queueMicrotask(() => this.#finish(null));
      }
      if (pressed?.repeating !== true) return;
      // Only messages after the press confirm it. `state` has no arrival time: any change of it is new.
      const telemetryStopped = latest !== null && latest.receivedAt >= pressed.at && latest.message.mode === "stopped";
      const stateStopped = device.state.value !== this.#stateAtPress && device.state.value?.mode === "stopped";
      if (telemetryStopped || stateStopped) {
        queueMicrotask(() => this.#finish(null));
      }
    });
    this.#disposeEffects = [clearError, confirm];
  }

  /** Latches Stop. Can be repeated at any time. */
  press(reason = "Stop pressed on the console"): void {
    if (this.#device.info.value.role === "viewer") {
      this.#error.value = "You can watch this device, but not stop it. Ask its owner or an operator at the robot.";
      return;
    }
    this.#stateAtPress = this.#device.state.value;
    const at = now();
    this.#error.value = null;
    this.#pressed.value = { kind: "sending", at, repeating: true };
    const message: Stop = { id: newId(), reason };
    clearInterval(this.#timer);
    this.#timer = setInterval(() => {
      const age = now() - at;
      if (age > REPEAT_FOR_MS) {
        this.#finish({ kind: this.#unconfirmed(), at, repeating: false });
        return;
      }
      if (age > CONFIRM_TIMEOUT_MS) this.#report(this.#unconfirmed(), at);
      this.#publish(message);
    }, REPEAT_MS);
    this.#publish(message);
    this.#api.stop(this.#device.id, reason).then(
      ({ outcome }) => this.#report(outcome === "confirmed" ? "latched" : outcome, at),
      (error: unknown) => {
        this.#error.value = sentence(error);
        this.#report("unreachable", at);
      },
    );
  }

  /** Resets the latch. No motion resumes. */
  async reset(): Promise<void> {
    this.#resetting.value = true;
    this.#error.value = null;
    try {
      const { confirmed, reason } = await this.#api.resetStop(this.#device.id);
      if (reason !== null) this.#error.value = `The robot rejected the reset: ${reason.message.replace(/\.$/, "")}.`;
      else if (!confirmed) this.#error.value = "The robot has not confirmed the reset yet.";
      this.#pressed.value = null;
    } catch (error) {
      this.#error.value = sentence(error);
    } finally {
      this.#resetting.value = false;
    }
  }

  dispose(): void {
    clearInterval(this.#timer);
    for (const dispose of this.#disposeEffects) dispose();
  }

  /** Without a confirmation: whether the Stop was sent, as far as this page knows. */
  #unconfirmed(): "sent" | "unreachable" {
    const unreachable = this.#pressed.value?.kind === "unreachable" || this.#device.reach.value === "offline";
    return unreachable ? "unreachable" : "sent";
  }

  /** Displays the outcome of the press at `at`, while it is the current one. */
  #report(kind: Pressed["kind"], at: number): void {
    const pressed = this.#pressed.value;
    if (pressed?.at !== at || !pressed.repeating) return;
    if (kind === "latched") this.#finish({ kind, at: now(), repeating: false });
    else this.#pressed.value = { ...pressed, kind };
  }

  #publish(message: Stop): void {
    // If the broker is unreachable, the HTTP call is the second channel; its error is displayed.
    this.#link.publish(this.#device.topics.stop(this.#author), message, 1).catch(() => undefined);
  }

  #finish(pressed: Pressed | null): void {
    clearInterval(this.#timer);
    this.#pressed.value = pressed;
  }
}
