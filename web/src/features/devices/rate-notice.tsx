import { format } from "../../shared/i18n/format";
import type { DeviceStore } from "./model/device-store";
import { reducedRates } from "./model/rates";
import { texts } from "./texts";

/** Rates that an overloaded agent has reduced. */
export function RateNotice({ device }: { device: DeviceStore }) {
  const reduced = reducedRates(device.description.value, device.state.value);
  if (reduced.length === 0 || !device.live.value) return null;
  const rates = reduced.map(({ name, measuredHz, configuredHz }) =>
    texts.device.rate(name, format.upToOneDigit(measuredHz), format.upToOneDigit(configuredHz)),
  );
  return (
    <p class="notice" role="status" data-testid="reduced-rates">
      {texts.device.overloaded(rates.join(", "))}
    </p>
  );
}
