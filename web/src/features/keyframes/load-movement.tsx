/** Loads a movement's keyframes from its script. */
import type { ComponentChildren } from "preact";
import { useEffect, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { ApiError, sentence } from "../../shared/api/http";
import { readScript } from "./model/script-codec";
import type { Movement } from "./model/keyframes";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import { movementAddress } from "../../shared/routing/routes";

/** `saved` is `null` for a new movement. */
export interface MovementReference {
  kind: "there";
  saved: Movement | null;
  version: number;
}

type Source = { kind: "loading" } | MovementReference | { kind: "by-hand" } | { kind: "failed"; why: string };

interface Reading {
  source: Source;
  again: () => void;
}

export function useMovementSource(api: Api, robotType: string, name: string): Reading {
  const [source, setSource] = useState<Source>(name === "" ? { kind: "there", saved: null, version: 0 } : { kind: "loading" });
  const [tries, setTries] = useState(0);
  useEffect(() => {
    if (name === "") return undefined;
    let wanted = true;
    void load(api, robotType, name).then((found) => wanted && setSource(found));
    return () => {
      wanted = false;
    };
  }, [api, robotType, name, tries]);
  return { source, again: () => setTries(tries + 1) };
}

interface LoadedProps extends Reading {
  robotType: string;
  name: string;
  children: (source: MovementReference) => ComponentChildren;
}

export function LoadMovement({ source, again, robotType, name, children }: LoadedProps) {
  switch (source.kind) {
    case "loading":
      return <p class="quiet">{common.loading}</p>;
    case "failed":
      return (
        <p class="notice bad" role="alert">
          {source.why}{" "}
          <button type="button" onClick={again}>
            {common.tryAgain}
          </button>
        </p>
      );
    case "by-hand":
      return (
        <p class="notice warn" role="alert" data-testid="kf-by-hand">
          {texts.byHand(name)} <a href={movementAddress(robotType, name)}>{texts.toCode}</a>
        </p>
      );
    case "there":
      return <>{children(source)}</>;
  }
}

async function load(api: Api, robotType: string, name: string): Promise<Source> {
  try {
    const found = await api.library.get(robotType, name);
    const read = readScript(found.source);
    if (read.kind !== "keyframes") return { kind: "by-hand" };
    return { kind: "there", saved: read.movement, version: found.built_in ? 0 : found.version };
  } catch (error) {
    if (error instanceof ApiError && error.status === 404) return { kind: "there", saved: null, version: 0 };
    return { kind: "failed", why: sentence(error) };
  }
}
