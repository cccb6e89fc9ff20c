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
  kind: "loaded";
  saved: Movement | null;
  version: number;
}

type Source = { kind: "loading" } | MovementReference | { kind: "manual-script" } | { kind: "failed"; reason: string };

interface LoadState {
  source: Source;
  reload: () => void;
}

export function useMovementSource(api: Api, robotType: string, name: string): LoadState {
  const [source, setSource] = useState<Source>(name === "" ? { kind: "loaded", saved: null, version: 0 } : { kind: "loading" });
  const [attempt, setAttempt] = useState(0);
  useEffect(() => {
    if (name === "") return undefined;
    let active = true;
    void load(api, robotType, name).then((found) => active && setSource(found));
    return () => {
      active = false;
    };
  }, [api, robotType, name, attempt]);
  return { source, reload: () => setAttempt(attempt + 1) };
}

interface LoadedProps extends LoadState {
  robotType: string;
  name: string;
  children: (source: MovementReference) => ComponentChildren;
}

export function LoadMovement({ source, reload, robotType, name, children }: LoadedProps) {
  switch (source.kind) {
    case "loading":
      return <p class="quiet">{common.loading}</p>;
    case "failed":
      return (
        <p class="notice bad" role="alert">
          {source.reason}{" "}
          <button type="button" onClick={reload}>
            {common.tryAgain}
          </button>
        </p>
      );
    case "manual-script":
      return (
        <p class="notice warn" role="alert" data-testid="kf-manual-script">
          {texts.manualScript(name)} <a href={movementAddress(robotType, name)}>{texts.toCode}</a>
        </p>
      );
    case "loaded":
      return <>{children(source)}</>;
  }
}

async function load(api: Api, robotType: string, name: string): Promise<Source> {
  try {
    const found = await api.library.get(robotType, name);
    const parsed = readScript(found.source);
    if (parsed.kind !== "keyframes") return { kind: "manual-script" };
    return { kind: "loaded", saved: parsed.movement, version: found.built_in ? 0 : found.version };
  } catch (error) {
    if (error instanceof ApiError && error.status === 404) return { kind: "loaded", saved: null, version: 0 };
    return { kind: "failed", reason: sentence(error) };
  }
}
