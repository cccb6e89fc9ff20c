/** Durations and shares as short texts that never round a small value to nothing. */
import type { MotionShare, StoredSession } from "../../../shared/api/autonomy";

const MINUTE_S = 60;
const HOUR_S = 3600;

/** 3.2 s, 42 s, 3 min 20 s, 2 h 5 min. */
export function durationText(seconds: number): string {
  if (seconds > 0 && seconds < 0.1) return "< 0.1 s";
  if (seconds < 9.95) return `${seconds.toFixed(1)} s`;
  const whole = Math.round(seconds);
  if (whole < MINUTE_S) return `${whole} s`;
  if (whole < HOUR_S) return `${Math.floor(whole / MINUTE_S)} min ${whole % MINUTE_S} s`;
  const minutes = Math.round(seconds / MINUTE_S);
  return `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

/** A share 0…1 in percent. Only exactly 0 is shown as 0 %, and only exactly 1 as 100 %. */
export function shareText(share: number): string {
  if (share > 0 && share < 0.001) return "< 0.1 %";
  if (share < 1 && share > 0.999) return "> 99.9 %";
  return `${Number((share * 100).toFixed(1))} %`;
}

/** A ratio of any size, with three significant digits. */
export function ratioText(ratio: number): string {
  if (ratio > 0 && ratio < 0.01) return "< 0.01";
  return ratio < 100 ? String(Number(ratio.toPrecision(3))) : String(Math.round(ratio));
}

interface Metrics {
  hti: string;
  mti: string;
  /** null: undefined, because no operator moved the robot. */
  mtia: string | null;
}

/** The metrics as texts; null without motion. */
export function metricsOf({ hti, mti, mtia }: MotionShare): Metrics | null {
  if (hti === null || mti === null) return null;
  return { hti: shareText(hti), mti: shareText(mti), mtia: mtia === null ? null : ratioText(mtia) };
}

/** Duration of a session until its end, or until now [s]; null if its start is unknown. */
export function secondsOf({ started_at: start, ended_at: end }: StoredSession, nowMs: number): number | null {
  if (start === null) return null;
  return Math.max(0, (end === null ? nowMs : Date.parse(end)) - Date.parse(start)) / 1000;
}
