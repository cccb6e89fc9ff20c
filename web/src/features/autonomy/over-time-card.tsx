/** The shares over days or weeks, stacked, as a chart or a table. */
import { useState } from "preact/hooks";
import type { Autonomy } from "../../shared/api/autonomy";
import { format } from "../../shared/i18n/format";
import { Card } from "../../shared/ui/card";
import { Choice } from "../../shared/ui/choice";
import { type Bar, barsOf, durationText, shareText, type Span } from "./model";
import { Key } from "./share-bar";
import { texts } from "./texts";

interface OverTimeProps {
  days: Autonomy["days"];
  span: Span;
  /** Time of the server [ms since 1970]. */
  nowMs: number;
}

/** About this many bars have a date below them. */
const DATES = 6;
const TICKS = [100, 50, 0];

export function OverTimeCard({ days, span, nowMs }: OverTimeProps) {
  const [view, setView] = useState<"chart" | "table">("chart");
  const bars = barsOf(days, span, nowMs);
  return (
    <Card
      title={texts.overTime}
      aside={<Choice label={texts.view} value={view} onChange={setView} options={Object.entries(texts.views) as ["chart" | "table", string][]} />}
    >
      {view === "chart" ? <Chart bars={bars} /> : <Rows bars={bars.filter(moved)} />}
    </Card>
  );
}

function moved({ operatorS, machineS }: Bar): boolean {
  return operatorS + machineS > 0;
}

function periodOf({ startMs, lastDayMs }: Bar): string {
  return texts.period(format.utcDay(startMs), lastDayMs === startMs ? null : format.utcDay(lastDayMs));
}

function Chart({ bars }: { bars: readonly Bar[] }) {
  const everyDate = Math.ceil(bars.length / DATES);
  return (
    <figure class="share-chart">
      <div class="share-plot">
        <div class="share-axis" aria-hidden="true">
          {TICKS.map((tick) => (
            <span key={tick}>{`${tick} %`}</span>
          ))}
        </div>
        <div class="share-columns" role="img" aria-label={texts.chart(bars.length, bars.filter(moved).length)} data-testid="share-chart" data-bars={bars.length}>
          {bars.map((bar) => (
            <Column key={bar.startMs} bar={bar} />
          ))}
        </div>
      </div>
      <div class="share-dates" aria-hidden="true">
        {bars.map((bar, index) => (
          <span key={bar.startMs}>{index % everyDate === 0 && <span>{format.utcDay(bar.startMs)}</span>}</span>
        ))}
      </div>
      <figcaption class="share-legend quiet small">
        <span>
          <Key source="operator" /> {texts.operator}
        </span>
        <span>
          <Key source="machine" /> {texts.machine}
        </span>
      </figcaption>
    </figure>
  );
}

function Column({ bar }: { bar: Bar }) {
  const { operatorS, machineS } = bar;
  const movingS = operatorS + machineS;
  if (movingS === 0) return <span class="share-column" />;
  const [operator, machine] = [operatorS / movingS, machineS / movingS];
  return (
    <span class="share-column" title={`${periodOf(bar)}: ${texts.bar(shareText(operator), shareText(machine))}, ${durationText(movingS)}`} data-testid="share-column">
      <span class="by-machine" style={{ flexGrow: String(machine) }} />
      <span class="by-operator" style={{ flexGrow: String(operator) }} />
    </span>
  );
}

function Rows({ bars }: { bars: readonly Bar[] }) {
  return (
    <div class="scroll" tabIndex={0} role="region" aria-label={texts.valuesOverTime}>
      <table data-testid="share-table">
        <thead>
          <tr>
            {texts.periodColumns.map((name) => (
              <th key={name} scope="col">
                {name}
              </th>
            ))}
          </tr>
        </thead>
        <tbody>
          {bars.toReversed().map((bar) => {
            const movingS = bar.operatorS + bar.machineS;
            return (
              <tr key={bar.startMs}>
                <th scope="row">{periodOf(bar)}</th>
                <td>{durationText(movingS)}</td>
                <td>{shareText(bar.operatorS / movingS)}</td>
                <td>{shareText(bar.machineS / movingS)}</td>
              </tr>
            );
          })}
        </tbody>
      </table>
    </div>
  );
}
