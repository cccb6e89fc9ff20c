/** One line for each robot; bars are sessions, and signs above them are events. */
import { deviceAddress } from "../../../shared/routing/routes";
import { format } from "../../../shared/i18n/format";
import { type Interval, type MarkKind, ticksOf } from "../model/fleet-timeline";
import { intervalText, markText } from "./entry-texts";
import type { NamedRow } from "./page";
import { texts } from "./texts";

interface ChartProps {
  rows: readonly NamedRow[];
  fromMs: number;
  toMs: number;
  tickMs: number;
}

const DAY_MS = 86_400_000;
const SIGNS: Readonly<Record<MarkKind, string>> = { stop: "■", fault: "▲", handover: "⇄" };

export function TimelineChart({ rows, fromMs, toMs, tickMs }: ChartProps) {
  const share = (atMs: number): number => Math.min(1, Math.max(0, (atMs - fromMs) / (toMs - fromMs)));
  const ticks = ticksOf(fromMs, toMs, tickMs);
  return (
    <figure class="timeline">
      {rows.map((row) => (
        <div class="timeline-row" key={row.device} data-testid="timeline-row" data-device={row.device}>
          <a href={deviceAddress(row.device)}>{row.label}</a>
          {row.error !== "" ? (
            <p class="notice bad">{texts.rowFailed(row.error)}</p>
          ) : (
            <div class="timeline-track" role="img" aria-label={texts.row(row.label, row.intervals.length, row.marks.length)}>
              {ticks.map((atMs) => (
                <span key={atMs} class="timeline-tick" style={{ left: percent(share(atMs)) }} />
              ))}
              {row.intervals.map((interval) => (
                <Bar key={interval.epoch} interval={interval} share={share} />
              ))}
              {row.marks.map((mark, index) => (
                <span
                  key={index}
                  class={`timeline-mark of-${mark.kind}`}
                  style={{ left: `clamp(0.4rem, ${percent(share(mark.atMs))}, 100% - 0.4rem)` }}
                  title={markText(mark)}
                  data-testid="timeline-mark"
                  data-kind={mark.kind}
                >
                  {SIGNS[mark.kind]}
                </span>
              ))}
            </div>
          )}
        </div>
      ))}
      <div class="timeline-row" aria-hidden="true">
        <span />
        <div class="timeline-axis">
          {ticks.map((atMs) => (
            <span key={atMs} style={{ left: percent(share(atMs)) }}>
              {tickMs < DAY_MS ? format.time(atMs).slice(0, 5) : format.day(atMs)}
            </span>
          ))}
        </div>
      </div>
      <figcaption class="timeline-legend quiet small">
        {(["person", "action"] as const).map((by) => (
          <span key={by}>
            <span class={`timeline-key by-${by}`} aria-hidden="true" /> {texts[by]}
          </span>
        ))}
        {(Object.keys(SIGNS) as MarkKind[]).map((kind) => (
          <span key={kind}>
            <span class={`of-${kind}`} aria-hidden="true">
              {SIGNS[kind]}
            </span>{" "}
            {texts.mark[kind]}
          </span>
        ))}
      </figcaption>
    </figure>
  );
}

function Bar({ interval, share }: { interval: Interval; share: (atMs: number) => number }) {
  const left = share(interval.fromMs);
  return (
    <span
      class={`timeline-bar by-${interval.by}`}
      style={{ left: `min(${percent(left)}, 100% - 3px)`, width: percent(share(interval.toMs) - left) }}
      title={intervalText(interval)}
      data-testid="timeline-session"
      data-epoch={interval.epoch}
      data-by={interval.by}
    />
  );
}

function percent(share: number): string {
  return `${(share * 100).toFixed(3)}%`;
}
