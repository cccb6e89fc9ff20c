/** All movements by robot type: search, open, create, and delete own ones. */
import type { Fleet } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { useEffect, useId, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { sentence } from "../../shared/api/http";
import type { Movement, RobotTypeEntry } from "../../shared/api/movement-library";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import { ConfirmButton } from "../../shared/ui/confirm-button";
import { movementAddress, typeKeyframesAddress } from "../../shared/routing/routes";
import "./movements.css";

interface TypeGroup {
  type: RobotTypeEntry;
  movements: readonly Movement[];
}

type Groups = { kind: "loading" } | { kind: "loaded"; items: readonly TypeGroup[] } | { kind: "failed"; why: string };

export function LibraryPage({ api, fleet }: { api: Api; fleet: Fleet }) {
  const [groups, setGroups] = useState<Groups>({ kind: "loading" });
  const [attempt, setAttempt] = useState(0);
  const [search, setSearch] = useState("");
  const [message, setMessage] = useState("");
  useEffect(() => {
    let active = true;
    read(api).then(
      (items) => active && setGroups({ kind: "loaded", items }),
      (error: unknown) => active && setGroups({ kind: "failed", why: sentence(error) }),
    );
    return () => {
      active = false;
    };
  }, [api, attempt]);

  const owned = new Set([...(fleet.devices.value?.values() ?? [])].map(({ info }) => info.value.robot_type));
  const items = groups.kind === "loaded" ? sorted(groups.items, owned) : [];
  const shown = items
    .map((group) => ({ ...group, movements: group.movements.filter((movement) => matches(group, movement, search)) }))
    .filter(({ movements }) => movements.length > 0 || search === "");
  return (
    <main class="page library" id="content">
      <h1>{texts.library.title}</h1>
      <p class="quiet">{texts.library.explain}</p>
      {groups.kind === "loaded" && <NewMovement groups={items} />}
      <div class="row-form">
        <label for="movement-search">{texts.library.search}</label>
        <div class="row">
          <input
            id="movement-search"
            type="text"
            data-testid="movement-search"
            placeholder={texts.library.searchExample}
            value={search}
            onInput={(event) => setSearch(event.currentTarget.value)}
          />
        </div>
      </div>
      <p class="field-note" role="status">
        {message}
      </p>
      {groups.kind === "loading" && (
        <p class="quiet" role="status">
          {common.loading}
        </p>
      )}
      {groups.kind === "failed" && (
        <p class="notice bad" role="alert">
          {texts.movements.failed(groups.why)}{" "}
          <button type="button" onClick={() => setAttempt(attempt + 1)}>
            {texts.movements.retry}
          </button>
        </p>
      )}
      {groups.kind === "loaded" && shown.length === 0 && <p class="quiet">{texts.library.noMatches}</p>}
      {shown.map((group) => (
        <GroupCard
          key={group.type.type}
          api={api}
          group={group}
          onRemoved={(name) => {
            setMessage(texts.library.removed(name));
            setAttempt(attempt + 1);
          }}
        />
      ))}
    </main>
  );
}

async function read(api: Api): Promise<TypeGroup[]> {
  const types = (await api.library.robotTypes()).filter(({ state }) => state === "ready");
  return Promise.all(types.map(async (type) => ({ type, movements: await api.library.list(type.type) })));
}

/** Types of own robots first. */
function sorted(groups: readonly TypeGroup[], owned: ReadonlySet<string>): TypeGroup[] {
  const rank = ({ type }: TypeGroup): number => (owned.has(type.type) ? 0 : 1);
  return groups.toSorted((a, b) => rank(a) - rank(b) || a.type.label.localeCompare(b.type.label));
}

function matches({ type }: TypeGroup, { name, description }: Movement, search: string): boolean {
  const text = [name, description, type.label, type.type].join(" ").toLowerCase().replaceAll("_", " ");
  return search.toLowerCase().replaceAll("_", " ").split(/\s+/).every((word) => text.includes(word));
}

interface GroupCardProps {
  api: Api;
  group: TypeGroup;
  onRemoved: (name: string) => void;
}

function GroupCard({ api, group, onRemoved }: GroupCardProps) {
  const { type, movements } = group;
  return (
    <Card title={type.label} aside={<span class="quiet small">{texts.library.count(movements.length)}</span>}>
      {movements.length === 0 && <p class="quiet">{texts.movements.none}</p>}
      <ul class="movement-list">
        {movements.map((movement) => (
          <li key={movement.name} data-testid={`movement-entry-${type.type}-${movement.name}`}>
            <span class="movement-name">
              <a href={movementAddress(type.type, movement.name)}>
                <strong>{movement.name}</strong>
              </a>{" "}
              <span class="chip">{movement.built_in ? texts.library.builtIn : texts.library.own}</span>
              <span class="small">{movement.description}</span>
              <span class="quiet small">
                {movement.built_in
                  ? texts.library.shipped(movement.version)
                  : texts.library.saved(movement.version, movement.updated_at)}
              </span>
            </span>
            {!movement.built_in && (
              <ConfirmButton
                label={texts.library.remove}
                description={texts.library.removeOf(movement.name)}
                question={texts.library.removeSure(movement.name)}
                confirmLabel={texts.library.removeYes}
                busyLabel={texts.library.removing}
                cancelLabel={texts.library.keep}
                data-testid={`remove-${movement.name}`}
                onConfirm={async () => {
                  await api.library.remove(type.type, movement.name);
                  onRemoved(movement.name);
                }}
              />
            )}
          </li>
        ))}
      </ul>
    </Card>
  );
}

function NewMovement({ groups }: { groups: readonly TypeGroup[] }) {
  const id = useId();
  const [type, setType] = useState(groups[0]?.type.type ?? "");
  const [name, setName] = useState("");
  const [error, setError] = useState("");
  const submit = (event: Event): void => {
    event.preventDefault();
    const exists = groups.find((group) => group.type.type === type)?.movements.some((each) => each.name === name);
    const why = !/^[A-Za-z0-9_-]{1,64}$/.test(name) ? texts.library.badName : exists === true ? texts.library.nameExists : "";
    setError(why);
    if (why === "") location.hash = movementAddress(type, name);
  };
  return (
    <form class="new-movement" onSubmit={submit}>
      <h2>{texts.library.create}</h2>
      <div class="row">
        <span class="field">
          <label for={`${id}-type`}>{texts.library.robotType}</label>
          <select id={`${id}-type`} data-testid="new-type" value={type} onChange={(event) => setType(event.currentTarget.value)}>
            {groups.map((group) => (
              <option key={group.type.type} value={group.type.type}>
                {group.type.label}
              </option>
            ))}
          </select>
        </span>
        <span class="field">
          <label for={`${id}-name`}>{texts.library.name}</label>
          <input
            id={`${id}-name`}
            type="text"
            data-testid="new-name"
            autocomplete="off"
            placeholder={texts.library.nameExample}
            aria-invalid={error !== ""}
            aria-describedby={`${id}-wrong`}
            value={name}
            onInput={(event) => setName(event.currentTarget.value.trim())}
          />
        </span>
        <button type="submit" class="primary" data-testid="new-movement">
          {texts.library.submit}
        </button>
        <a class="elsewhere" data-testid="new-keyframes" href={typeKeyframesAddress(type)}>
          {texts.library.beginKeyframes}
        </a>
      </div>
      <p id={`${id}-wrong`} class="field-error" role="alert">
        {error}
      </p>
    </form>
  );
}
