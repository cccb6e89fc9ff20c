/** The keyframe editor of a robot type, for who has no robot at hand: nothing moves but the drawing. */
import { useCallback, useMemo } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { robotOf } from "../robot-types/model/robot-types";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import { useLoaded } from "../../shared/hooks/use-resource";
import { movementAddress, movementsAddress, typeKeyframesAddress } from "../../app/routes";
import { Desk } from "./editor";
import { Loaded, useSource } from "./load-movement";

interface TypeKeyframesPageProps {
  api: Api;
  robotType: string;
  /** Of the movement; empty: a new one. */
  name: string;
}

export function TypeKeyframesPage({ api, robotType, name }: TypeKeyframesPageProps) {
  const type = useLoaded(useCallback(() => api.robotTypes.get(robotType), [api, robotType]));
  const model = useLoaded(useCallback(() => api.robotTypes.model(robotType), [api, robotType]));
  const robot = useMemo(() => (type.value === null ? null : robotOf(type.value)), [type.value]);
  const loaded = useSource(api, robotType, name);
  const trouble = type.trouble !== "" ? type : model;
  return (
    <main class="page kf-page" id="content">
      <div class="heading">
        <a href={name === "" ? movementsAddress : movementAddress(robotType, name)}>← {name === "" ? texts.library : name}</a>
        <h1>{texts.title}</h1>
        <p class="quiet">
          {type.value?.label ?? robotType.replaceAll("_", " ")}
          {name !== "" && ` · ${name}`}
        </p>
      </div>
      {trouble.trouble !== "" && (
        <p class="notice bad" role="alert">
          {trouble.trouble}{" "}
          <button type="button" onClick={trouble.again}>
            {common.tryAgain}
          </button>
        </p>
      )}
      <Loaded robotType={robotType} name={name} {...loaded}>
        {(source) => (
          <Desk
            api={api}
            name={name}
            source={source}
            robotType={robotType}
            robot={robot}
            twin={model.value?.twin ?? null}
            measured={null}
            home={type.value?.home_rad}
            waits={type.value === null}
            station={null}
            address={(saved) => typeKeyframesAddress(robotType, saved)}
          />
        )}
      </Loaded>
    </main>
  );
}
