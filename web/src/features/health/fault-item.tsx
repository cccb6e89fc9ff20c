/** One fault: its history and the events around it. */
import type { DeviceStore } from "../devices/model";
import { Age } from "../../shared/ui/age";
import type { Fault, StoredEvent } from "../../shared/api/health";
import { useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { intervalAround, type FaultComparison } from "./model/health";
import { toPageClock } from "../../shared/lib/clock";
import { sentence } from "../../shared/api/http";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

interface FaultItemProps {
  api: Api;
  device: DeviceStore;
  comparison: FaultComparison;
  /** Called after an action, to reload the faults. */
  onChange: () => void;
  /** Shows the trend of the measured field. */
  showTrend: (stream: string, field: string) => void;
}

const CHIP = { error: "bad", warning: "reach-stale", info: "" } as const;

export function FaultItem({ api, device, comparison, onChange, showTrend }: FaultItemProps) {
  const { stored, reported, agreement } = comparison;
  const head = useRef<HTMLHeadingElement>(null);
  const severity = stored?.severity ?? "error";
  return (
    <li
      class={`fault ${stored?.state === "cleared" ? "ended" : severity}`}
      data-testid="fault"
      data-code={stored?.code ?? reported?.code}
      data-state={stored?.state ?? "reported"}
    >
      <h3 ref={head} tabIndex={-1}>
        <span class={`chip ${CHIP[severity]}`}>{texts.health.severity[severity]}</span>{" "}
        {texts.health.kind[stored?.kind ?? "reported"] ?? stored?.kind} <span class="quiet">{stored?.code ?? reported?.code}</span>
      </h3>
      <p>{stored?.message ?? reported?.message}</p>
      {agreement !== "same" && (
        <p class="quiet small" data-testid="agreement" data-agreement={agreement}>
          {texts.health.agreement[agreement]}
        </p>
      )}
      {stored === null ? (
        reported !== null && (
          <p class="quiet small">
            <Age at={toPageClock(reported.since_ms)} as={texts.health.raisedAgo} />
          </p>
        )
      ) : (
        <>
          <FaultHistory fault={stored} />
          <div class="row no-print">
            {stored.state === "raised" && (
              <Acknowledge api={api} device={device} fault={stored} onDone={() => (onChange(), head.current?.focus())} />
            )}
            {stored.stream !== "" && (
              <button type="button" onClick={() => showTrend(stored.stream, stored.field)}>
                {texts.health.showTrend}
              </button>
            )}
          </div>
          <RelatedEvents api={api} device={device} fault={stored} />
        </>
      )}
    </li>
  );
}

/** Raised, acknowledged and cleared, each with its time. */
function FaultHistory({ fault }: { fault: Fault }) {
  const labels = texts.health.history;
  const timedLabel = (at: string, label: string) => (
    <>
      <strong>{label}</strong> <time dateTime={at}>{format.dateTime(at)}</time>{" "}
      <span class="quiet">
        <Age at={toPageClock(Date.parse(at))} />
      </span>
    </>
  );
  return (
    <>
      <ol class="fault-history" aria-label={labels.title}>
        <li class="past">{timedLabel(fault.raised_at, labels.raised)}</li>
        <li class={fault.acknowledged_at === null ? "" : "past"}>
          {fault.acknowledged_at === null
            ? fault.cleared_at === null
              ? labels.notAcknowledged
              : labels.clearedUnacknowledged
            : timedLabel(fault.acknowledged_at, labels.acknowledgedBy(fault.acknowledged_by))}
        </li>
        <li class={fault.cleared_at === null ? "" : "past"}>
          {fault.cleared_at === null ? labels.open : timedLabel(fault.cleared_at, labels.cleared)}
        </li>
      </ol>
      <p class="quiet small">
        {[labels.source[fault.source], labels.count(fault.count), labels.worsened(fault.worsened), labels.recurred(fault.occurrences, fault.last_seen_at)].filter((one) => one !== "").join(" · ")}
      </p>
    </>
  );
}

interface AcknowledgeProps {
  api: Api;
  device: DeviceStore;
  fault: Fault;
  onDone: () => void;
}

function Acknowledge({ api, device, fault, onDone }: AcknowledgeProps) {
  const [busy, setBusy] = useState(false);
  const [error, setError] = useState("");
  if (device.info.value.role === "viewer") return <span class="quiet small">{texts.health.viewer}</span>;
  const acknowledge = (): void => {
    setBusy(true);
    setError("");
    api.health.acknowledge(device.id, fault.id).then(onDone, (error: unknown) => {
      setBusy(false);
      setError(sentence(error));
    });
  };
  return (
    <>
      <button type="button" class="primary" data-testid="acknowledge" disabled={busy} onClick={acknowledge}>
        {busy ? texts.health.saving : texts.health.acknowledge}
      </button>
      <span class="quiet small">{texts.health.noUndo}</span>
      {error !== "" && (
        <span role="alert" class="field-error">
          {error}
        </span>
      )}
    </>
  );
}

const PAGE = 200;
const PAGES = 5;
const SHOWN = 50;

/** Messages from one minute before the fault to one minute after it; loaded when opened. */
function RelatedEvents({ api, device, fault }: Pick<FaultItemProps, "api" | "device"> & { fault: Fault }) {
  const [events, setEvents] = useState<readonly StoredEvent[] | null>(null);
  const [error, setError] = useState("");
  const load = (): void => {
    setError("");
    loadEventsAround(api, device.id, fault).then(setEvents, (error: unknown) => setError(sentence(error)));
  };
  return (
    <details class="related-events no-print" onToggle={(event) => event.currentTarget.open && load()}>
      <summary>{texts.health.relatedEvents}</summary>
      {error !== "" && <p class="notice bad">{error}</p>}
      {events === null && error === "" && <p class="quiet">{common.loading}</p>}
      {events !== null && (
        <ul class="event-list">
          {events.slice(0, SHOWN).map((event) => (
            <li key={event.id} class={event.severity}>
              <time class="quiet" dateTime={event.at}>
                {format.time(Date.parse(event.at))}
              </time>{" "}
              {texts.health.event[event.kind] ?? event.kind.replaceAll("-", " ")}: {event.message}
            </li>
          ))}
          {events.length === 0 && <li class="quiet">{texts.health.noRelatedEvents}</li>}
        </ul>
      )}
    </details>
  );
}

async function loadEventsAround(api: Api, device: string, fault: Fault): Promise<StoredEvent[]> {
  const [from, to] = intervalAround(fault);
  const found: StoredEvent[] = [];
  let cursor: string | null = null;
  for (let page = 0; page < PAGES; page += 1) {
    const { items, cursor: next } = await api.health.events(device, cursor, PAGE);
    found.push(...items.filter(({ at }) => Date.parse(at) >= from && Date.parse(at) <= to));
    cursor = next;
    if (cursor === null || Date.parse(items.at(-1)?.at ?? "") < from) break;
  }
  return found;
}
