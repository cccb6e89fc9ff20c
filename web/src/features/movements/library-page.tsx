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

interface Shelf {
  type: RobotTypeEntry;
  movements: readonly Movement[];
}

type Shelves = { kind: "loading" } | { kind: "there"; items: readonly Shelf[] } | { kind: "failed"; why: string };

export function LibraryPage({ api, fleet }: { api: Api; fleet: Fleet }) {
  const [shelves, setShelves] = useState<Shelves>({ kind: "loading" });
  const [tries, setTries] = useState(0);
  const [search, setSearch] = useState("");
  const [told, setTold] = useState("");
  useEffect(() => {
    let wanted = true;
    read(api).then(
      (items) => wanted && setShelves({ kind: "there", items }),
      (error: unknown) => wanted && setShelves({ kind: "failed", why: sentence(error) }),
    );
    return () => {
      wanted = false;
    };
  }, [api, tries]);

  const owned = new Set([...(fleet.devices.value?.values() ?? [])].map(({ info }) => info.value.robot_type));
  const items = shelves.kind === "there" ? sorted(shelves.items, owned) : [];
  const shown = items
    .map((shelf) => ({ ...shelf, movements: shelf.movements.filter((movement) => fits(shelf, movement, search)) }))
    .filter(({ movements }) => movements.length > 0 || search === "");
  return (
    <main class="page library" id="content">
      <h1>{texts.library.title}</h1>
      <p class="quiet">{texts.library.explain}</p>
      {shelves.kind === "there" && <NewMovement shelves={items} />}
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
        {told}
      </p>
      {shelves.kind === "loading" && (
        <p class="quiet" role="status">
          {common.loading}
        </p>
      )}
      {shelves.kind === "failed" && (
        <p class="notice bad" role="alert">
          {texts.movements.failed(shelves.why)}{" "}
          <button type="button" onClick={() => setTries(tries + 1)}>
            {texts.movements.retry}
          </button>
        </p>
      )}
      {shelves.kind === "there" && shown.length === 0 && <p class="quiet">{texts.library.nothing}</p>}
      {shown.map((shelf) => (
        <TypeShelf
          key={shelf.type.type}
          api={api}
          shelf={shelf}
          onRemoved={(name) => {
            setTold(texts.library.removed(name));
            setTries(tries + 1);
          }}
        />
      ))}
    </main>
  );
}

async function read(api: Api): Promise<Shelf[]> {
  const types = (await api.library.robotTypes()).filter(({ state }) => state === "ready");
  return Promise.all(types.map(async (type) => ({ type, movements: await api.library.list(type.type) })));
}

/** Types of own robots first. */
function sorted(shelves: readonly Shelf[], owned: ReadonlySet<string>): Shelf[] {
  const rank = ({ type }: Shelf): number => (owned.has(type.type) ? 0 : 1);
  return shelves.toSorted((a, b) => rank(a) - rank(b) || a.type.label.localeCompare(b.type.label));
}

function fits({ type }: Shelf, { name, description }: Movement, search: string): boolean {
  const text = [name, description, type.label, type.type].join(" ").toLowerCase().replaceAll("_", " ");
  return search.toLowerCase().replaceAll("_", " ").split(/\s+/).every((word) => text.includes(word));
}

interface TypeShelfProps {
  api: Api;
  shelf: Shelf;
  onRemoved: (name: string) => void;
}

function TypeShelf({ api, shelf, onRemoved }: TypeShelfProps) {
  const { type, movements } = shelf;
  return (
    <Card title={type.label} aside={<span class="quiet small">{texts.library.count(movements.length)}</span>}>
      {movements.length === 0 && <p class="quiet">{texts.movements.none}</p>}
      <ul class="movement-list">
        {movements.map((movement) => (
          <li key={movement.name} data-testid={`shelf-${type.type}-${movement.name}`}>
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

function NewMovement({ shelves }: { shelves: readonly Shelf[] }) {
  const id = useId();
  const [type, setType] = useState(shelves[0]?.type.type ?? "");
  const [name, setName] = useState("");
  const [wrong, setWrong] = useState("");
  const begin = (event: Event): void => {
    event.preventDefault();
    const there = shelves.find((shelf) => shelf.type.type === type)?.movements.some((each) => each.name === name);
    const why = !/^[A-Za-z0-9_-]{1,64}$/.test(name) ? texts.library.badName : there === true ? texts.library.taken : "";
    setWrong(why);
    if (why === "") location.hash = movementAddress(type, name);
  };
  return (
    <form class="new-movement" onSubmit={begin}>
      <h2>{texts.library.create}</h2>
      <div class="row">
        <span class="field">
          <label for={`${id}-type`}>{texts.library.robotType}</label>
          <select id={`${id}-type`} data-testid="new-type" value={type} onChange={(event) => setType(event.currentTarget.value)}>
            {shelves.map((shelf) => (
              <option key={shelf.type.type} value={shelf.type.type}>
                {shelf.type.label}
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
            aria-invalid={wrong !== ""}
            aria-describedby={`${id}-wrong`}
            value={name}
            onInput={(event) => setName(event.currentTarget.value.trim())}
          />
        </span>
        <button type="submit" class="primary" data-testid="new-movement">
          {texts.library.begin}
        </button>
        <a class="elsewhere" data-testid="new-keyframes" href={typeKeyframesAddress(type)}>
          {texts.library.beginKeyframes}
        </a>
      </div>
      <p id={`${id}-wrong`} class="field-error" role="alert">
        {wrong}
      </p>
    </form>
  );
}
