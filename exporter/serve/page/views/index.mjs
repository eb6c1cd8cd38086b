/** The views by the scene that site.json names. */

import { view as ball3d } from "./ball3d.mjs";
import { view as gridworld } from "./gridworld.mjs";
import { view as hallway } from "./hallway.mjs";
import { tennisView } from "./tennis.mjs";

export function viewOf(site) {
  const views = { ball3d: () => ball3d, gridworld: () => gridworld, hallway: () => hallway, tennis: () => tennisView(site) };
  return views[site.scene]();
}
