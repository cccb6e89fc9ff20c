/** Two sessions side by side: the second one follows the cursor of the first. */
import { computed, effect, signal, type ReadonlySignal } from "@preact/signals-core";
import { clamp } from "../../../../../shared/lib/angles";
import type { Moment, Range, Replay } from "../replay";
import type { Samples } from "../samples";
import type { Timeline } from "../timeline";
import { type Differences, differencesOf, figuresOf, type SessionFigures } from "./differences";
import { type Alignment, offsetOf } from "./selection";

/** `empty`: the second session has no recording. `joints`: its robot has other joints. `apart`: no common time. */
export type ComparisonState = "loading" | "empty" | "joints" | "apart" | "ready";

export class Comparison {
  readonly first: Replay;
  readonly second: Replay;
  readonly #alignment = signal<Alignment>({ first_s: 0, second_s: 0 });
  readonly #dispose: () => void;

  readonly alignment: ReadonlySignal<Alignment> = this.#alignment;
  /** Time in the second session minus the time in the first one [s]. */
  readonly offset_s = computed<number>(() => offsetOf(this.#alignment.value));
  /** The visible part of the time axis, in the time of the second session. */
  readonly window = computed<Range>(() => {
    const { from_s, to_s } = this.first.window.value;
    return { from_s: from_s + this.offset_s.value, to_s: to_s + this.offset_s.value };
  });
  /** The state of the second session at the cursor. */
  readonly moment = computed<Moment>(() => (this.#within(this.#at.value) ? this.second.moment.value : { kind: "none", reason: "gap" }));
  readonly figures = computed<readonly [SessionFigures, SessionFigures]>(() => [figuresOf(samplesOf(this.first.timeline.value)), figuresOf(samplesOf(this.second.timeline.value))]);
  readonly differences = computed<Differences>(() =>
    this.#sameJoints() ? differencesOf(samplesOf(this.first.timeline.value), samplesOf(this.second.timeline.value), this.offset_s.value) : { overlap_s: 0, joints: [] },
  );
  readonly state = computed<ComparisonState>(() => this.#state());
  /** Whether overviews are still loading, so that the figures are not final. */
  readonly partial = computed<boolean>(() => [this.first, this.second].some(({ timeline }) => timeline.value.parts.some(({ overview }) => overview === null)));

  readonly #at = computed<number>(() => this.first.cursor.value + this.offset_s.value);

  constructor(first: Replay, second: Replay) {
    this.first = first;
    this.second = second;
    this.#dispose = effect(() => {
      const duration_s = this.second.timeline.value.duration_s;
      this.second.seek(clamp(this.#at.value, 0, duration_s));
    });
  }

  align(alignment: Alignment): void {
    this.#alignment.value = alignment;
  }

  dispose(): void {
    this.#dispose();
  }

  #state(): ComparisonState {
    const session = this.second.session.value;
    if (session === null) return "loading";
    if ((session.recording?.segments.length ?? 0) === 0) return "empty";
    const known = (replay: Replay): boolean => replay.timeline.value.joints.length > 0;
    if (!known(this.first) || !known(this.second)) return "loading";
    if (!this.#sameJoints()) return "joints";
    if (this.differences.value.overlap_s > 0) return "ready";
    return this.partial.value ? "loading" : "apart";
  }

  #sameJoints(): boolean {
    return this.first.timeline.value.joints.join() === this.second.timeline.value.joints.join();
  }

  #within(at_s: number): boolean {
    return at_s >= 0 && at_s <= this.second.timeline.value.duration_s;
  }
}

function samplesOf({ parts }: Timeline): Samples[] {
  return parts.flatMap(({ overview }) => (overview === null || typeof overview === "string" ? [] : [overview]));
}
