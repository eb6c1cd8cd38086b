/** The views by the scene that site.json names. */

import { viewOf as ball3d } from "./ball3d.mjs";
import { viewOf as crawler2d } from "./crawler2d.mjs";
import { viewOf as gridworld } from "./gridworld.mjs";
import { viewOf as hallway } from "./hallway.mjs";
import { viewOf as tennis } from "./tennis.mjs";

const VIEWS = { ball3d, crawler2d, gridworld, hallway, tennis };

export const viewOf = (site) => VIEWS[site.scene](site);
