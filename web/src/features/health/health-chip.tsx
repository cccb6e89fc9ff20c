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
const STORED_AFTER_MS = 1_500;

const KIND: Readonly<Record<HealthState, string>> = { ok: "reach-online", unknown: "", warning: "reach-stale", fault: "bad" };

export function HealthLabel({ health }: { health: HealthState }) {
  return (
    <span class={`chip ${KIND[health]}`} data-testid="health" data-health={health}>
      {texts.health.state[health]}
    </span>
  );
}

/** Reloads when the device reports other faults: immediately, and after they are stored. */
export function useReportedFaults(told: string, again: Polled<unknown>["refresh"]): void {
  useEffect(() => {
    again();
    const timer = setTimeout(again, STORED_AFTER_MS);
    return () => clearTimeout(timer);
  }, [told, again]);
}

/** The number of open faults, with a link to the health page. */
export function HealthChip({ api, device }: { api: Api; device: DeviceStore }) {
  const told = reportedFaults(device);
  const { value, refresh } = usePolling(() => api.health.of(device.id), EVERY_MS, [api, device]);
  useReportedFaults(codes(told), refresh);
  if (value === null && told === null) return null;
  const count = openCount(value?.faults ?? null, told);
  const bad = (told?.length ?? 0) > 0 || value?.health === "fault";
  const kind = count === 0 ? "" : bad ? "bad" : "reach-stale";
  return (
    <a class={`chip ${kind}`} href={healthAddressOf("device", device.id)} data-testid="health-chip" data-count={count}>
      {texts.health.chip(count)}
    </a>
  );
}

export function codes(told: readonly { code: string }[] | null): string {
  return told === null ? "?" : told.map(({ code }) => code).join(" ");
}
