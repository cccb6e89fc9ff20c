import type { Account, Space } from "../../shared/api/types";
import type { Fleet } from "../devices/model";
import { PageExplainer } from "../../shared/help";
import { AccessList } from "../sharing";
import { useEffect, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { sentence } from "../../shared/api/http";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import { RoomView } from "./room-view";
import { deviceListAddress, healthAddressOf, replaceWith } from "../../shared/routing/routes";

interface SpacePageProps {
  api: Api;
  fleet: Fleet;
  account: Account;
  id: string;
}

/** One space: its devices and its access list. */
export function SpacePage({ api, fleet, account, id }: SpacePageProps) {
  const [space, setSpace] = useState<Space | null | undefined>(undefined);
  const [error, setError] = useState("");
  const devices = fleet.devices.value;
  useEffect(() => {
    let active = true;
    api.spaces().then(
      (found) => {
        if (!active) return;
        setSpace(found.find((each) => each.id === id) ?? null);
        setError("");
      },
      (error: unknown) => active && setError(texts.spaces.failed(sentence(error))),
    );
    return () => {
      active = false;
    };
    // Reload when devices change: the space may have been shared or unshared.
  }, [api, id, devices]);

  const members = [...(devices?.values() ?? [])].filter(({ info }) => info.value.space === id);
  return (
    <main class="page space" id="content">
      <a href={deviceListAddress}>← {common.allDevices}</a>
      {error !== "" && <p class="notice bad">{error}</p>}
      {space === undefined && error === "" && <p class="quiet">{common.loading}</p>}
      {space === null && <p role="status">{texts.spaces.missing}</p>}
      {space !== undefined && space !== null && (
        <>
          <h1>{space.name}</h1>
          <p>
            <a href={healthAddressOf("space", id)}>{texts.spaces.healthOf(space.name)}</a>
          </p>
          {members.length === 0 ? <p class="quiet">{texts.spaces.empty}</p> : <RoomView fleet={fleet} id={id} />}
          <PageExplainer page="space" />
          <AccessList
            api={api}
            account={account}
            target={{ kind: "space", id }}
            unit={{ kind: "space", id }}
            included={members.map(({ info }) => info.value.label)}
            owner={space.owner}
            role={space.role}
            onLeft={() => {
              void fleet.refresh();
              replaceWith(deviceListAddress);
            }}
          />
        </>
      )}
    </main>
  );
}
