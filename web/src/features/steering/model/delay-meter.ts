/**
 * Measures why setpoints are late, from the page's own timer and the robot's telemetry: this browser was busy, the network
 * was late, or the robot's computer was.
 */
import type { KnownTelemetry } from "../../../shared/mqtt/parse-messages";

export interface Delay {
  cause: "browser" | "network" | "robot";
  /** Time without a setpoint [ms]. */
  ms: number;
}

/** Delays count for this long [ms]. */
const WINDOW_MS = 1_500;
/** Gaps of the page's timer and of the robot's telemetry below this are ordinary [ms]. */
const ORDINARY_MS = 100;

interface Measured extends Delay {
  at: number;
}

export class DelayMeter {
  #measured: Measured[] = [];
  #tickedAt: number | null = null;
  #newest: KnownTelemetry | null = null;
  #receivedAt = 0;

  /** Records a step of the page's timer. */
  tick(at: number): void {
    if (this.#tickedAt !== null) this.#record("browser", at - this.#tickedAt, at);
    this.#tickedAt = at;
  }

  /** Records the newest telemetry; it may be the same as before. */
  receive(message: KnownTelemetry, receivedAt: number): void {
    const previous = this.#newest;
    if (previous === message) return;
    this.#newest = message;
    const arrival = receivedAt - this.#receivedAt;
    this.#receivedAt = receivedAt;
    if (previous === null || message.sequence <= previous.sequence) return;
    // The mean gap between two messages on the robot's own clock: the network does not affect it.
    const own = (message.tick_ms - previous.tick_ms) / (message.sequence - previous.sequence);
    this.#record("robot", own, receivedAt);
    this.#record("network", Math.max(arrival - own, message.loop_age_ms), receivedAt);
  }

  /** Records that a setpoint has been waiting for the network since `sentAt`. */
  wait(sentAt: number, at: number): void {
    this.#record("network", at - sentAt, at);
  }

  /** The cause of the longest delay of the last 1.5 s, if any. A busy browser also receives late, so it takes precedence. */
  longest(at: number): Delay | null {
    this.#measured = this.#measured.filter((one) => at - one.at < WINDOW_MS);
    const byLength = this.#measured.toSorted((a, b) => b.ms - a.ms);
    const [longest] = byLength;
    if (longest === undefined) return null;
    const browser = byLength.find(({ cause }) => cause === "browser");
    const { cause, ms } = browser !== undefined && browser.ms > longest.ms / 2 ? browser : longest;
    return { cause, ms: Math.round(ms) };
  }

  #record(cause: Delay["cause"], ms: number, at: number): void {
    if (ms >= ORDINARY_MS) this.#measured.push({ cause, ms, at });
  }
}
