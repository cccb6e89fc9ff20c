/** The keyframe editor of a robot type, for who has no robot at hand: nothing moves but the drawing. */
import { useCallback, useMemo } from "preact/hooks";
import type { Api } from "../../core/api";
import { robotOf } from "../../core/robot-types";
import { texts } from "../../texts";
import { useLoaded } from "../robot-types/use-loaded";
import { movementAddress, movementsAddress, typeKeyframesAddress } from "../route";
import { Desk } from "./desk";
import { Loaded, useSource } from "./source";

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
        <a href={name === "" ? movementsAddress : movementAddress(robotType, name)}>← {name === "" ? texts.library.title : name}</a>
        <h1>{texts.keyframes.title}</h1>
        <p class="quiet">
          {type.value?.label ?? robotType.replaceAll("_", " ")}
          {name !== "" && ` · ${name}`}
        </p>
      </div>
      {trouble.trouble !== "" && (
        <p class="notice bad" role="alert">
          {trouble.trouble}{" "}
          <button type="button" onClick={trouble.again}>
            {texts.later.again}
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
