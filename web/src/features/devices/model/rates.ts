/** Rates of a device's streams and cameras on an overloaded machine. */
import type { Description, State } from "../../../shared/mqtt/protocol.generated";

/** Below this share of its configured rate, a stream is listed. */
const NOTICEABLE = 0.8;

export interface ReducedRate {
  name: string;
  measuredHz: number;
  configuredHz: number;
}

/** The streams and cameras that are slower than configured while the agent reduces work. */
export function reducedRates(
  description: Pick<Description, "streams" | "cameras"> | null,
  state: Pick<State, "load" | "rates_hz"> | null,
): ReducedRate[] {
  if (description === null || state === null || (state.load ?? 0) === 0) return [];
  const configured = [
    ...(description.streams ?? []).map(({ name, rate_hz: rate }) => ({ key: `tele/${name}`, name, rate })),
    ...(description.cameras ?? []).map(({ name, rate_hz: rate }) => ({ key: `cam/${name}`, name, rate })),
  ];
  return configured
    .map(({ key, name, rate }) => ({ name, measuredHz: state.rates_hz?.[key] ?? rate, configuredHz: rate }))
    .filter(({ measuredHz, configuredHz }) => measuredHz < NOTICEABLE * configuredHz);
}
