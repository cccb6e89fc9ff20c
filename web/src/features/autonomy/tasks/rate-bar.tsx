/** A success rate as a bar: the interval, and a line at the rate. */
import type { Rate } from "../../../shared/api/tasks";
import { rateText } from "../model";

/** Without counted trials, the bar is empty. */
export function RateBar({ rate }: { rate: Rate }) {
  const label = rateText(rate);
  const percent = (share: number): string => `${share * 100}%`;
  return (
    <span class="rate-bar" role="img" aria-label={label} title={label} data-testid="rate" data-rate={rate.rate ?? ""}>
      {rate.rate !== null && (
        <>
          <span class="rate-interval" style={{ left: percent(rate.lower), width: percent(rate.upper - rate.lower) }} />
          <span class="rate-value" style={{ left: percent(rate.rate) }} />
        </>
      )}
    </span>
  );
}
