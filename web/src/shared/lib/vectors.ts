/** Metres, x y z. */
export type Vector3 = [number, number, number];
/** w x y z. */
export type Quaternion = [number, number, number, number];
/** Position x, y, z [m] and quaternion w, x, y, z of a frame in the robot's base. */
export type Pose = [number, number, number, number, number, number, number];
