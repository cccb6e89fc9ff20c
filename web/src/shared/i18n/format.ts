/** Formats numbers, times and sizes. Internal values are SI and radians; only the UI uses degrees. */
const dateTimeFormat = new Intl.DateTimeFormat("en-GB", { dateStyle: "medium", timeStyle: "short" });
const oneDigitFormat = new Intl.NumberFormat("en", { minimumFractionDigits: 1, maximumFractionDigits: 1, useGrouping: false });
const timeFormat = new Intl.DateTimeFormat("en-GB", { hour: "2-digit", minute: "2-digit", second: "2-digit" });
const dayFormat = new Intl.DateTimeFormat("en-GB", { day: "numeric", month: "short" });
const utcDayFormat = new Intl.DateTimeFormat("en-GB", { day: "numeric", month: "short", timeZone: "UTC" });
const dayAndTimeFormat = new Intl.DateTimeFormat("en-GB", { day: "numeric", month: "short", hour: "2-digit", minute: "2-digit" });

function oneDigit(value: number): string {
  return oneDigitFormat.format(Object.is(Math.round(value * 10), -0) ? 0 : value);
}

export const format = {
  oneDigit,
  upToOneDigit: (value: number): string => String(Math.round(value * 10) / 10),
  degrees: (deg: number): string => `${oneDigit(deg)}°`,
  radiansAsDegrees: (rad: number): string => `${oneDigit((rad * 180) / Math.PI)}°`,
  wholeDegrees: (deg: number): string => `${Math.round(deg)}°`,
  percent: (share: number): string => `${Math.round(share * 100)} %`,
  milliseconds: (ms: number): string => (ms < 10 ? `${oneDigit(ms)} ms` : `${Math.round(ms)} ms`),
  unknown: "–",

  age: (ms: number): string => {
    const s = ms / 1000;
    if (s < 2) return "just now";
    if (s < 60) return `${Math.floor(s)} s ago`;
    if (s < 3600) return `${Math.floor(s / 60)} min ago`;
    if (s < 48 * 3600) return `${Math.floor(s / 3600)} h ago`;
    return `${Math.floor(s / 86400)} days ago`;
  },
  /** Rounded to the largest fitting unit. */
  duration: (s: number): string => {
    const [count, unit] = s < 5400 ? [s / 60, "minute"] : s < 2 * 86_400 ? [s / 3600, "hour"] : [s / 86_400, "day"];
    const whole = Math.max(1, Math.round(count));
    return whole === 1 ? `1 ${unit}` : `${whole} ${unit}s`;
  },
  /** Of an RFC 3339 time. */
  dateTime: (at: string): string => dateTimeFormat.format(new Date(at)),
  until: (at: string | null): string => (at === null ? "until revoked" : `until ${format.dateTime(at)}`),
  time: (ms: number): string => timeFormat.format(ms),
  day: (ms: number): string => dayFormat.format(ms),
  utcDay: (ms: number): string => utcDayFormat.format(ms),
  /** Without the day if less than twelve hours ago. */
  recentTime: (ms: number): string => (Date.now() - ms < 12 * 3_600_000 ? timeFormat : dayAndTimeFormat).format(ms),
  fileSize: (bytes: number): string => {
    if (bytes < 1e6) return `${bytes && Math.max(1, Math.round(bytes / 1e3))} kB`;
    return bytes < 1e9 ? `${(bytes / 1e6).toFixed(1)} MB` : `${(bytes / 1e9).toFixed(1)} GB`;
  },
  count: (count: number, noun: string): string => `${count} ${noun}${count === 1 ? "" : "s"}`,
};
