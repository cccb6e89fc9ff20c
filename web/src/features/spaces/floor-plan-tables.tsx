import type { DeviceStore } from "../devices/model";
import { valueText } from "../sensors";
import { quantityOf } from "../sensors/model";
import { Age } from "../../shared/ui/age";
import { degrees } from "../../shared/lib/angles";
import { clock } from "../../shared/lib/clock";
import { type Place } from "./model/room-perception";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { deviceAddress } from "../../shared/routing/routes";
import type { LiveSensors } from "./model/sightings";
import { RANGE, type MountedDevice, deviceOf, nameOf } from "./floor-plan";

export function Legend({ seen }: { seen: LiveSensors }) {
  return (
    <ul class="plan-key quiet small">
      <li class="key-taken">{texts.plan.key.taken}</li>
      <li class="key-unknown">{texts.plan.key.unknown}</li>
      {seen.echoes.length > 0 && <li class="key-echo">{texts.plan.key.echo}</li>}
      {seen.people.length > 0 && <li class="key-person">{texts.plan.key.person}</li>}
      <li class="key-metre">{texts.plan.metre}</li>
    </ul>
  );
}

interface OccupantTableProps {
  places: readonly Place[];
  devices: readonly DeviceStore[];
  receivedAt: number;
  old: boolean;
}

export function OccupantTable({ places, devices, receivedAt, old }: OccupantTableProps) {
  const metres = (m: number): string => m.toFixed(2);
  const since = Math.max(0, clock.value - receivedAt);
  const { column } = texts.plan;
  return (
    <div class="scroll" tabIndex={0} role="region" aria-label={texts.plan.occupants}>
      <table class={old ? "old" : ""}>
        <thead>
          <tr>
            {[column.name, column.place, column.heading, column.seen].map((name) => (
              <th key={name} scope="col">
                {name}
              </th>
            ))}
          </tr>
        </thead>
        <tbody>
          {places.map((place, index) => {
            const device = deviceOf(place, devices);
            const label = nameOf(place, devices);
            return (
              <tr key={place.name}>
                <th scope="row">
                  <span class={`swatch series-${(index % 8) + 1}`} aria-hidden="true">
                    {texts.plan.letter(index)}
                  </span>
                  {device === null ? label : <a href={deviceAddress(device.id)}>{label}</a>}
                </th>
                <td>{texts.plan.place(metres(place.xM), metres(place.yM))}</td>
                <td>{place.yawRad === null ? format.unknown : format.wholeDegrees(degrees(place.yawRad))}</td>
                <td>{format.age(place.ageS * 1000 + since)}</td>
              </tr>
            );
          })}
        </tbody>
      </table>
    </div>
  );
}

/** The numbered devices of the plan with their current values. */
export function MountedDeviceList({ mounted }: { mounted: readonly MountedDevice[] }) {
  return (
    <>
      <h3>{texts.plan.sensors}</h3>
      <ol class="mounted-devices">
        {mounted.map(({ device, number }) => (
          <li key={device.id}>
            <span class="pin-number" aria-hidden="true">
              {number}
            </span>
            <a href={deviceAddress(device.id)}>{device.info.value.label}</a>
            <CurrentValues device={device} />
          </li>
        ))}
      </ol>
    </>
  );
}

/** Current values: of a lidar the nearest distance, of others the first two. */
function CurrentValues({ device }: { device: DeviceStore }) {
  const description = device.description.value;
  const stream = description?.streams[0]?.name;
  if (description === null || stream === undefined) return null;
  const newest = device.measured(stream).value;
  const values = Object.entries(newest?.message.values ?? {});
  if (newest === null || values.length === 0) return <span class="quiet">{format.unknown}</span>;
  const late = device.late(stream);
  const valueOf = (field: string, value: number | boolean): string => {
    if (typeof value === "boolean") return (common.booleanState[field] ?? common.yesNo)[value ? 0 : 1];
    const quantity = quantityOf(description, stream, field);
    return `${valueText(quantity, value)} ${quantity.unit}`;
  };
  const [first, second] = stream === RANGE ? [[...values].sort(([, a], [, b]) => Number(a) - Number(b))[0]] : values;
  return (
    <span class={late ? "old" : "value"}>
      {[first, second].flatMap((one) => (one === undefined ? [] : [valueOf(...one)])).join(", ")}
      {late && (
        <span class="small">
          {" "}
          <Age at={newest.receivedAt} />
        </span>
      )}
    </span>
  );
}
