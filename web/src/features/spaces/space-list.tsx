import type { Space } from "../../shared/api/types";
import type { Fleet } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { useEffect, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { sentence } from "../../shared/api/http";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import { spaceAddress } from "../../shared/routing/routes";

/** The accessible spaces, and a form to create one. */
export function SpaceList({ api, fleet }: { api: Api; fleet: Fleet }) {
  const [spaces, setSpaces] = useState<readonly Space[] | null>(null);
  const [error, setError] = useState("");
  const devices = fleet.devices.value;
  const load = async (): Promise<void> => {
    try {
      setSpaces(await api.spaces());
      setError("");
    } catch (error) {
      setError(texts.spaces.failed(sentence(error)));
    }
  };
  // Reload when devices change: a space may have been added or removed.
  useEffect(() => void load(), [api, devices]);
  const count = (id: string): number =>
    [...(devices?.values() ?? [])].filter(({ info }) => info.value.space === id).length;
  return (
    <Card title={texts.spaces.title} class="spaces">
      {spaces === null && error === "" && <p class="quiet">{common.loading}</p>}
      {spaces?.length === 0 && <p class="quiet">{texts.spaces.none}</p>}
      <ul class="people">
        {spaces?.map(({ id, name, role, owner }) => (
          <li key={id}>
            <a class="person" href={spaceAddress(id)} data-testid="space-link">
              {name}
            </a>
            <span class="quiet small">
              {texts.spaces.devices(count(id))}
              {role !== "owner" && ` · ${texts.spaces.of(owner.name)}`}
            </span>
            <span class={`chip role-${role}`}>{common.role[role]}</span>
          </li>
        ))}
      </ul>
      <p class="field-error" aria-live="polite" hidden={error === ""}>
        {error}
      </p>
      <CreateSpaceForm api={api} onCreated={() => void load()} />
    </Card>
  );
}

function CreateSpaceForm({ api, onCreated }: { api: Api; onCreated: () => void }) {
  const [name, setName] = useState("");
  const [busy, setBusy] = useState(false);
  const [message, setMessage] = useState({ text: "", error: false });
  const create = async (): Promise<void> => {
    setBusy(true);
    setMessage({ text: "", error: false });
    try {
      const created = await api.createSpace(name.trim());
      setName("");
      setMessage({ text: texts.spaces.created(created.name), error: false });
      onCreated();
    } catch (error) {
      setMessage({ text: sentence(error), error: true });
    } finally {
      setBusy(false);
    }
  };
  return (
    <form
      class="row-form"
      onSubmit={(event) => {
        event.preventDefault();
        void create();
      }}
    >
      <label for="space-name">{texts.spaces.name}</label>
      <div class="row">
        <input
          id="space-name"
          type="text"
          autocomplete="off"
          required
          maxLength={200}
          value={name}
          aria-describedby="space-answer"
          onInput={(event) => setName(event.currentTarget.value)}
        />
        <button type="submit" disabled={busy}>
          {busy ? texts.spaces.creating : texts.spaces.create}
        </button>
      </div>
      <p id="space-answer" class={message.error ? "field-error" : "field-note"} aria-live="polite">
        {message.text}
      </p>
    </form>
  );
}
