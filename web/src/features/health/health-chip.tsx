/** The health of a device as a chip. */
import type { DeviceStore } from "../devices/model";
import type { HealthState } from "../../shared/api/health";
import { useEffect } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { openCount, reportedFaults } from "./model/health";
import { texts } from "./texts";
import { usePolling, type Polled } from "../../shared/hooks/use-polling";
import { healthAddressOf } from "../../shared/routing/routes";

const EVERY_MS = 15_000;
/** The cloud stores device reports with this delay [ms]. */
const STORE_DELAY_MS = 1_500;

const CHIP_CLASS: Readonly<Record<HealthState, string>> = { ok: "reach-online", unknown: "", warning: "reach-stale", fault: "bad" };

export function HealthLabel({ health }: { health: HealthState }) {
  return (
    <span class={`chip ${CHIP_CLASS[health]}`} data-testid="health" data-health={health}>
      {texts.health.state[health]}
    </span>
  );
}

/** Reloads when the device reports other faults: immediately, and after they are stored. */
export function useReportedFaults(reported: string, again: Polled<unknown>["refresh"]): void {
  useEffect(() => {
    again();
    const timer = setTimeout(again, STORE_DELAY_MS);
    return () => clearTimeout(timer);
  }, [reported, again]);
}

/** The number of open faults, with a link to the health page. */
export function HealthChip({ api, device }: { api: Api; device: DeviceStore }) {
  const reported = reportedFaults(device);
  const { value, refresh } = usePolling(() => api.health.of(device.id), EVERY_MS, [api, device]);
  useReportedFaults(codes(reported), refresh);
  if (value === null && reported === null) return null;
  const count = openCount(value?.faults ?? null, reported);
  const bad = (reported?.length ?? 0) > 0 || value?.health === "fault";
  const kind = count === 0 ? "" : bad ? "bad" : "reach-stale";
  return (
    <a class={`chip ${kind}`} href={healthAddressOf("device", device.id)} data-testid="health-chip" data-count={count}>
      {texts.health.chip(count)}
    </a>
  );
}

export function codes(reported: readonly { code: string }[] | null): string {
  return reported === null ? "?" : reported.map(({ code }) => code).join(" ");
}
