/** One fault: its history and the events around it. */
import type { DeviceStore } from "../devices/model";
import { Age } from "../../shared/ui/age";
import type { Fault, StoredEvent } from "../../shared/api/health";
import { useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { intervalAround, type Standing } from "./model/health";
import { toPageClock } from "../../shared/lib/clock";
import { sentence } from "../../shared/api/http";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

interface FaultItemProps {
  api: Api;
  device: DeviceStore;
  standing: Standing;
  /** Called after an action, to reload the faults. */
  changed: () => void;
  /** Shows the trend of the measured field. */
  show: (stream: string, field: string) => void;
}

const CHIP = { error: "bad", warning: "reach-stale", info: "" } as const;

export function FaultItem({ api, device, standing, changed, show }: FaultItemProps) {
  const { stored, told, agreement } = standing;
  const head = useRef<HTMLHeadingElement>(null);
  const severity = stored?.severity ?? "error";
  return (
    <li
      class={`fault ${stored?.state === "cleared" ? "ended" : severity}`}
      data-testid="fault"
      data-code={stored?.code ?? told?.code}
      data-state={stored?.state ?? "told"}
    >
      <h3 ref={head} tabIndex={-1}>
        <span class={`chip ${CHIP[severity]}`}>{texts.health.severity[severity]}</span>{" "}
        {texts.health.kind[stored?.kind ?? "reported"] ?? stored?.kind} <span class="quiet">{stored?.code ?? told?.code}</span>
      </h3>
      <p>{stored?.message ?? told?.message}</p>
      {agreement !== "same" && (
        <p class="quiet small" data-testid="agreement" data-agreement={agreement}>
          {texts.health.agreement[agreement]}
        </p>
      )}
      {stored === null ? (
        told !== null && (
          <p class="quiet small">
            <Age at={toPageClock(told.since_ms)} as={texts.health.saidSince} />
          </p>
        )
      ) : (
        <>
          <Life fault={stored} />
          <div class="row no-print">
            {stored.state === "raised" && (
              <Acknowledge api={api} device={device} fault={stored} done={() => (changed(), head.current?.focus())} />
            )}
            {stored.stream !== "" && (
              <button type="button" onClick={() => show(stored.stream, stored.field)}>
                {texts.health.showTrend}
              </button>
            )}
          </div>
          <Around api={api} device={device} fault={stored} />
        </>
      )}
    </li>
  );
}

/** Raised, acknowledged and cleared, each with its time. */
function Life({ fault }: { fault: Fault }) {
  const words = texts.health.life;
  const moment = (at: string, what: string) => (
    <>
      <strong>{what}</strong> <time dateTime={at}>{format.dateTime(at)}</time>{" "}
      <span class="quiet">
        <Age at={toPageClock(Date.parse(at))} />
      </span>
    </>
  );
  return (
    <>
      <ol class="life" aria-label={words.title}>
        <li class="past">{moment(fault.raised_at, words.raised)}</li>
        <li class={fault.acknowledged_at === null ? "" : "past"}>
          {fault.acknowledged_at === null
            ? fault.cleared_at === null
              ? words.unseen
              : words.neverSeen
            : moment(fault.acknowledged_at, words.seen(fault.acknowledged_by))}
        </li>
        <li class={fault.cleared_at === null ? "" : "past"}>
          {fault.cleared_at === null ? words.open : moment(fault.cleared_at, words.cleared)}
        </li>
      </ol>
      <p class="quiet small">
        {[words.source[fault.source], words.count(fault.count), words.worsened(fault.worsened)].filter((one) => one !== "").join(" · ")}
      </p>
    </>
  );
}

interface AcknowledgeProps {
  api: Api;
  device: DeviceStore;
  fault: Fault;
  done: () => void;
}

function Acknowledge({ api, device, fault, done }: AcknowledgeProps) {
  const [busy, setBusy] = useState(false);
  const [why, setWhy] = useState("");
  if (device.info.value.role === "viewer") return <span class="quiet small">{texts.health.watchOnly}</span>;
  const acknowledge = (): void => {
    setBusy(true);
    setWhy("");
    api.health.acknowledge(device.id, fault.id).then(done, (error: unknown) => {
      setBusy(false);
      setWhy(sentence(error));
    });
  };
  return (
    <>
      <button type="button" class="primary" data-testid="acknowledge" disabled={busy} onClick={acknowledge}>
        {busy ? texts.health.saving : texts.health.acknowledge}
      </button>
      <span class="quiet small">{texts.health.noUndo}</span>
      {why !== "" && (
        <span role="alert" class="field-error">
          {why}
        </span>
      )}
    </>
  );
}

const PAGE = 200;
const PAGES = 5;
const SHOWN = 50;

/** Messages from one minute before the fault to one minute after it; loaded when opened. */
function Around({ api, device, fault }: Pick<FaultItemProps, "api" | "device"> & { fault: Fault }) {
  const [events, setEvents] = useState<readonly StoredEvent[] | null>(null);
  const [why, setWhy] = useState("");
  const open = (): void => {
    setWhy("");
    loadEventsAround(api, device.id, fault).then(setEvents, (error: unknown) => setWhy(sentence(error)));
  };
  return (
    <details class="around no-print" onToggle={(event) => event.currentTarget.open && open()}>
      <summary>{texts.health.around}</summary>
      {why !== "" && <p class="notice bad">{why}</p>}
      {events === null && why === "" && <p class="quiet">{common.loading}</p>}
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
          {events.length === 0 && <li class="quiet">{texts.health.nothingAround}</li>}
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
