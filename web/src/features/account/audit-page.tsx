import type { Space } from "../../shared/api/types";
import type { Fleet } from "../devices/model";
import { useEffect, useMemo, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { accountNamesOf, AuditReader, ALL_ENTRIES } from "./model/audit-log";
import type { ApiKey, AuditQuery, AuditRecord } from "../../shared/api/sharing";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { entryText, type Names } from "./audit-entry-text";
import { accountAddress } from "../../shared/routing/routes";
import "./account.css";

const DAY_MS = 86_400_000;

interface Filter {
  event: string;
  target: string;
  from: string;
  to: string;
}

const ALL: Filter = { event: "", target: "", from: "", to: "" };

/** Values of date inputs in local time; `to` includes the whole day. */
function toQuery({ event, target, from, to }: Filter): AuditQuery {
  const start = (date: string): number => new Date(`${date}T00:00`).getTime();
  return {
    ...ALL_ENTRIES,
    event,
    target,
    sinceMs: from === "" ? null : start(from),
    untilMs: to === "" ? null : start(to) + DAY_MS,
  };
}

/** The audit log of the account. */
export function AuditLogPage({ api, fleet }: { api: Api; fleet: Fleet }) {
  const reader = useMemo(() => new AuditReader(api), [api]);
  const [filter, setFilter] = useState(ALL);
  const [spaces, setSpaces] = useState<readonly Space[]>([]);
  const [keys, setKeys] = useState<readonly ApiKey[]>([]);
  useEffect(() => {
    // Names only: on an error, ids are shown instead.
    api.spaces().then(setSpaces, () => undefined);
    api.apiKeys().then(setKeys, () => undefined);
  }, [api]);
  useEffect(() => void reader.load(toQuery(filter)), [reader, filter]);

  const records = reader.records.value;
  const devices = [...(fleet.devices.value?.values() ?? [])].map(({ info }) => info.value);
  const names: Names = useMemo(
    () => ({
      accounts: accountNamesOf(records),
      targets: new Map([...spaces.map(({ id, name }) => [id, name] as const), ...devices.map(({ id, label }) => [id, label] as const)]),
      keys: keyNames(keys, records),
    }),
    [records, spaces, keys, fleet.devices.value],
  );
  const ownDevices = devices.filter(({ role }) => role === "owner");
  const ownSpaces = spaces.filter(({ role }) => role === "owner");
  const subjects: [string, [string, string][]][] = [
    [texts.audit.control, ownDevices.map(({ id, label }) => [id, label])],
    [
      texts.audit.sharing,
      [
        ...ownSpaces.map(({ id, name }): [string, string] => [`space:${id}`, name]),
        ...ownDevices.map(({ id, label }): [string, string] => [`device:${id}`, label]),
      ],
    ],
    [texts.keys.title, [...names.keys].map(([id, name]) => [`key:${id}`, name])],
  ];
  return (
    <main class="page fleet activity" id="content">
      <a href={accountAddress}>← {texts.audit.back}</a>
      <h1>{texts.audit.title}</h1>
      <p class="quiet">{texts.audit.explained}</p>
      <Filters filter={filter} subjects={subjects} onChange={setFilter} />
      <Records reader={reader} names={names} filtered={filter !== ALL} />
    </main>
  );
}

/** Names of existing keys, and of deleted keys in the log. */
function keyNames(keys: readonly ApiKey[], records: readonly AuditRecord[]): ReadonlyMap<string, string> {
  const names = new Map(keys.map(({ id, name }) => [id, name]));
  for (const { event, target, data } of records) {
    const { name } = data;
    if (event === "api-key-made" && typeof name === "string") names.set(target.replace(/^key:/, ""), name);
  }
  return names;
}

interface FiltersProps {
  filter: Filter;
  /** Subject filter groups: title, then values and names. */
  subjects: readonly [string, readonly [string, string][]][];
  onChange: (filter: Filter) => void;
}

function Filters({ filter, subjects, onChange }: FiltersProps) {
  const update = (part: Partial<Filter>): void => onChange({ ...filter, ...part });
  return (
    <fieldset class="card filters">
      <legend class="visually-hidden">{texts.audit.filters}</legend>
      <div class="field">
        <label for="audit-event">{texts.audit.type}</label>
        <select
          id="audit-event"
          data-testid="audit-event"
          value={filter.event}
          onChange={(event) => update({ event: event.currentTarget.value })}
        >
          <option value="">{texts.audit.any}</option>
          {Object.entries(texts.audit.kinds).map(([kind, name]) => (
            <option key={kind} value={kind}>
              {name}
            </option>
          ))}
        </select>
      </div>
      <div class="field">
        <label for="audit-target">{texts.audit.subject}</label>
        <select id="audit-target" value={filter.target} onChange={(event) => update({ target: event.currentTarget.value })}>
          <option value="">{texts.audit.any}</option>
          {subjects.map(([title, entries]) =>
            entries.length === 0 ? null : (
              <optgroup key={title} label={title}>
                {entries.map(([id, name]) => (
                  <option key={id} value={id}>
                    {name}
                  </option>
                ))}
              </optgroup>
            ),
          )}
        </select>
      </div>
      {(["from", "to"] as const).map((end) => (
        <div class="field" key={end}>
          <label for={`audit-${end}`}>{texts.audit[end]}</label>
          <input
            id={`audit-${end}`}
            type="date"
            value={filter[end]}
            onChange={(event) => update({ [end]: event.currentTarget.value })}
          />
        </div>
      ))}
      {filter !== ALL && (
        <button type="button" onClick={() => onChange(ALL)}>
          {texts.audit.reset}
        </button>
      )}
    </fieldset>
  );
}

function Records({ reader, names, filtered }: { reader: AuditReader; names: Names; filtered: boolean }) {
  const records = reader.records.value;
  const busy = reader.busy.value;
  const more = reader.more.value;
  const error = reader.error.value;
  const empty = records.length === 0 && !busy && error === "";
  return (
    <>
      <ol class="card records" data-testid="audit" hidden={records.length === 0}>
        {records.map((record) => (
          <Line key={record.seq} record={record} names={names} />
        ))}
      </ol>
      <p class="quiet" role="status">
        {busy
          ? common.loading
          : empty
            ? more
              ? texts.audit.noneSoFar
              : texts.audit.none
            : error === "" && `${texts.audit.shown(records.length)}${more ? "" : ` · ${texts.audit.end}`}`}
      </p>
      {error !== "" && (
        <p class="notice bad" role="alert">
          {texts.audit.failed(error)}
        </p>
      )}
      {(more || error !== "") && (
        <p>
          <button type="button" disabled={busy} data-testid="older" onClick={() => void reader.loadOlder()}>
            {error !== "" ? texts.audit.retry : filtered ? texts.audit.searchFurther : texts.audit.loadOlder}
          </button>
        </p>
      )}
    </>
  );
}

function Line({ record, names }: { record: AuditRecord; names: Names }) {
  const { outcome, key, seq, at, target, account, session, hash } = record;
  const labels = texts.audit.fields;
  const details = [
    [labels.number, String(seq)],
    [labels.on, target],
    [labels.account, account],
    [labels.session, session],
    [labels.key, key],
    [labels.hash, hash],
  ] as const;
  return (
    <li data-event={record.event}>
      <details>
        <summary>
          <time dateTime={at}>{format.dateTime(at)}</time>
          <span class="record-text">
            {entryText(record, names)}
            {key !== "" && <span class="quiet"> ({texts.audit.byKey})</span>}{" "}
            {outcome !== "done" && (
              <span class={`chip ${outcome === "unknown" ? "" : "bad"}`} title={outcome === "unknown" ? texts.audit.unknownExplained : undefined}>
                {texts.audit.outcome[outcome]}
              </span>
            )}
          </span>
        </summary>
        <dl class="details">
          {details.map(([name, value]) =>
            value === "" ? null : (
              <div key={name}>
                <dt>{name}</dt>
                <dd>{value}</dd>
              </div>
            ),
          )}
        </dl>
      </details>
    </li>
  );
}
