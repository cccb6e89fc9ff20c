import type { Space } from "../../shared/api/types";
import type { Fleet } from "../devices/model";
import { SHARED_ROLES } from "../sharing";
import { Card } from "../../shared/ui/card";
import { Choice } from "../../shared/ui/choice";
import { useEffect, useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { sentence } from "../../shared/api/http";
import type { ApiKey, CreatedApiKey, SharedRole } from "../../shared/api/sharing";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import { InlineForm } from "../../shared/ui/inline-form";
import { ConfirmButton } from "../../shared/ui/confirm-button";
import { useReturnFocus } from "../../shared/hooks/use-return-focus";
import { CopyOnce } from "../../shared/ui/copy-once";
import "./account.css";

/** Scopes of an API key, by their value in `only`. */
type Names = ReadonlyMap<string, string>;

export function ApiKeys({ api, fleet }: { api: Api; fleet: Fleet }) {
  const [keys, setKeys] = useState<readonly ApiKey[] | null>(null);
  const [spaces, setSpaces] = useState<readonly Space[]>([]);
  const [error, setError] = useState("");
  const [message, setMessage] = useState("");
  const [creating, setCreating] = useState(false);
  const [created, setCreated] = useState<CreatedApiKey | null>(null);

  const load = async (): Promise<void> => {
    try {
      const [items, spaceItems] = await Promise.all([api.apiKeys(), api.spaces()]);
      setKeys(items);
      setSpaces(spaceItems);
      setError("");
    } catch (error) {
      setError(texts.keys.failed(sentence(error)));
    }
  };
  useEffect(() => void load(), [api]);
  const revoke = async ({ id, name }: ApiKey): Promise<void> => {
    await api.revokeApiKey(id);
    setKeys((previous) => previous?.filter((each) => each.id !== id) ?? null);
    setMessage(texts.keys.revoked(name));
  };

  const devices = [...(fleet.devices.value?.values() ?? [])];
  const names: Names = new Map([
    ...spaces.map(({ id, name }) => [`space:${id}`, name] as const),
    ...devices.map(({ id, info }) => [id, info.value.label] as const),
  ]);
  const busy = creating || created !== null;
  const opener = useReturnFocus(busy);
  const createButton = busy ? null : (
    <button type="button" ref={opener} data-testid="new-key" onClick={() => setCreating(true)}>
      {texts.keys.new}
    </button>
  );
  return (
    <Card title={texts.keys.title} class="keys" aside={createButton}>
      <p class="quiet">{texts.keys.explained}</p>
      {created !== null && <CreatedKey made={created} onDone={() => setCreated(null)} />}
      {creating && (
        <KeyForm
          api={api}
          names={names}
          onCreated={(result) => {
            setCreating(false);
            setCreated(result);
            setKeys((previous) => [result.api_key, ...(previous ?? [])]);
          }}
          onClose={() => setCreating(false)}
        />
      )}
      {keys === null && error === "" && <p class="quiet">{common.loading}</p>}
      {keys?.length === 0 && <p class="quiet">{texts.keys.none}</p>}
      <ul class="people" data-testid="keys">
        {keys?.map((key) => (
          <KeyRow key={key.id} of={key} names={names} onRevoke={() => revoke(key)} />
        ))}
      </ul>
      <p class={error === "" ? "field-note" : "field-error"} role="status">
        {error === "" ? message : error}
      </p>
    </Card>
  );
}

function KeyRow({ of: key, names, onRevoke }: { of: ApiKey; names: Names; onRevoke: () => Promise<void> }) {
  const only = key.only.map((each) => names.get(each) ?? texts.keys.deletedTarget).join(", ");
  const details = [
    only === "" ? texts.keys.everything : texts.keys.onlyScope(only),
    key.expired ? texts.keys.expired(key.expires_at) : texts.keys.until(key.expires_at),
    key.last_used_at === null ? texts.keys.unused : texts.keys.used(key.last_used_at),
    texts.keys.createdAt(key.created_at),
  ];
  return (
    <li data-testid="key" data-name={key.name}>
      <span class="person">
        {key.name}
        <span class="quiet small">{details.join(" · ")}</span>
      </span>
      {key.expired && <span class="chip bad">{texts.keys.expiredChip}</span>}
      <span class={`chip role-${key.role}`}>{common.role[key.role]}</span>
      <ConfirmButton
        label={texts.keys.revoke}
        description={texts.keys.revokeOf(key.name)}
        question={texts.keys.revokeQuestion(key.name)}
        confirmLabel={texts.keys.revokeConfirm}
        busyLabel={texts.keys.revoking}
        cancelLabel={texts.keys.cancel}
        data-testid="revoke-key"
        onConfirm={onRevoke}
      />
    </li>
  );
}

function CreatedKey({ made, onDone }: { made: CreatedApiKey; onDone: () => void }) {
  const box = useRef<HTMLDivElement>(null);
  useEffect(() => box.current?.querySelector("input")?.focus(), []);
  return (
    <div class="panel made" ref={box} role="group" aria-label={texts.keys.token}>
      <p>
        <strong>{texts.keys.created(made.api_key.name)}</strong>
      </p>
      <CopyOnce id="api-key-token" label={texts.keys.token} value={made.token} />
      <p class="quiet small">
        {texts.keys.usage} <code>Authorization: Bearer {made.token.slice(0, 3)}…</code>
      </p>
      <div class="row">
        <button type="button" data-testid="key-done" onClick={onDone}>
          {texts.keys.done}
        </button>
      </div>
    </div>
  );
}

interface KeyFormProps {
  api: Api;
  names: Names;
  onCreated: (made: CreatedApiKey) => void;
  onClose: () => void;
}

const SCOPES = [
  ["all", texts.keys.all],
  ["some", texts.keys.some],
] as const;

function KeyForm({ api, names, onCreated, onClose }: KeyFormProps) {
  const [name, setName] = useState("");
  const [role, setRole] = useState<SharedRole>("viewer");
  const [scope, setScope] = useState<"all" | "some">("all");
  const [only, setOnly] = useState<ReadonlySet<string>>(new Set());
  const [days, setDays] = useState("90");
  const [busy, setBusy] = useState(false);
  const [error, setError] = useState("");
  const choose = (chosen: ReadonlySet<string>): void => {
    setOnly(chosen);
    setError("");
  };
  const first = useRef<HTMLInputElement>(null);
  useEffect(() => first.current?.focus(), []);

  const create = async (): Promise<void> => {
    const chosen = scope === "all" ? [] : [...only].filter((each) => names.has(each));
    if (scope === "some" && chosen.length === 0) {
      setError(texts.keys.chooseOne);
      return;
    }
    setBusy(true);
    setError("");
    try {
      onCreated(await api.createApiKey({ name: name.trim(), role, only: chosen, days: Number(days) }));
    } catch (error) {
      setError(sentence(error)); // The input stays.
      setBusy(false);
    }
  };

  return (
    <InlineForm
      label={texts.keys.new}
      submitLabel={texts.keys.create}
      busyLabel={texts.keys.creating}
      busy={busy}
      error={error}
      submitTestId="make-key"
      onSubmit={create}
      onClose={onClose}
    >
      <div class="field">
        <label for="key-name">{texts.keys.name}</label>
        <input
          id="key-name"
          ref={first}
          type="text"
          autocomplete="off"
          required
          maxLength={60}
          placeholder={texts.keys.nameExample}
          value={name}
          onInput={(event) => setName(event.currentTarget.value)}
        />
      </div>
      <div class="field">
        <span class="label">{texts.keys.role}</span>
        <Choice label={texts.keys.role} value={role} options={SHARED_ROLES} onChange={setRole} />
      </div>
      <div class="field">
        <label for="key-days">{texts.keys.days}</label>
        <input
          id="key-days"
          type="number"
          min={1}
          max={366}
          required
          value={days}
          aria-describedby="key-days-note"
          onInput={(event) => setDays(event.currentTarget.value)}
        />
        <p class="quiet small" id="key-days-note">
          {texts.keys.daysNote}
        </p>
      </div>
      <div class="field wide">
        <span class="label">{texts.keys.scope}</span>
        <Choice label={texts.keys.scope} value={scope} options={SCOPES} onChange={setScope} />
      </div>
      {scope === "some" && <ScopePicker names={names} chosen={only} onChange={choose} />}
    </InlineForm>
  );
}

interface ScopePickerProps {
  names: Names;
  chosen: ReadonlySet<string>;
  onChange: (chosen: ReadonlySet<string>) => void;
}

function ScopePicker({ names, chosen, onChange }: ScopePickerProps) {
  const groups = [
    [texts.keys.spaces, [...names].filter(([id]) => id.startsWith("space:"))],
    [texts.keys.devices, [...names].filter(([id]) => !id.startsWith("space:"))],
  ] as const;
  const toggle = (id: string): void => {
    const next = new Set(chosen);
    if (!next.delete(id)) next.add(id);
    onChange(next);
  };
  return (
    <div class="field wide which">
      {groups.map(([title, entries]) =>
        entries.length === 0 ? null : (
          <fieldset key={title}>
            <legend>{title}</legend>
            {entries.map(([id, name]) => (
              <label key={id} class="tick">
                <input type="checkbox" checked={chosen.has(id)} onChange={() => toggle(id)} /> {name}
              </label>
            ))}
          </fieldset>
        ),
      )}
    </div>
  );
}
