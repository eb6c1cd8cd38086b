/** Twelve platforms in perspective, each with its ball. */

import { Ball3D, HALF_SIDE, RADIUS, TIME_STEP } from "../scenes/ball3d.mjs";
import { between, disc } from "./drawing.mjs";

const AGENTS = 12;
const SPACING = { x: 7.4, z: 7.8 }; // m, between the middles of platforms
const THICKNESS = 0.75; // m
const GROUND = -1.7; // m, where the shadow falls
const PITCH = 0.62; // rad, of the camera above the horizon
const CORNERS = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map((corner) => corner.map((n) => n * HALF_SIDE));

const view = {
  name: "3DBall",
  story:
    "Each platform keeps its ball up by tilting. An episode is 20 seconds; a ball that rolls off starts the next. " +
    "Drag a ball and let it go, or click beside it.",
  poke: "Nudge the balls",
  stepSeconds: TIME_STEP,
  agents: AGENTS,
  ratio: (width) => (width < 560 ? 1.2 : 1.9),
  labels: {
    observations: [
      ...["tilt about z", "tilt about x", "ball x", "ball height", "ball z"],
      ...["ball speed x", "ball speed up", "ball speed z"],
    ],
    actions: ["turn about z", "turn about x"],
  },
  create: () => new Ball3D(AGENTS),
  players: ["model"],
  observed: (observation) => observation,
  actions: ({ model }) => model,
  count: (tally) => `lost ${tally.bad}`,
  status(env, tally) {
    const longest = Math.max(...env.age) * TIME_STEP;
    return `${AGENTS} balls · longest ${longest.toFixed(1)} s of 20 s · kept to the end ${tally.good}`;
  },
  describe(env, tally, chosen) {
    const [x, z] = env.position[chosen];
    return (
      `${AGENTS} tilting platforms with a ball each. ${tally.bad} balls were lost so far. On platform ${chosen + 1} the ball ` +
      `is ${Math.hypot(x, z).toFixed(1)} metres from the middle.`
    );
  },
  gusts: true,
  at,
  draw,
};

export const viewOf = () => view;

/** Where the platforms stand, and what projects a point of the world. */
function layout({ width, height }) {
  const columns = width < 560 ? 3 : 4;
  const rows = AGENTS / columns;
  const platforms = Array.from({ length: AGENTS }, (_, i) => {
    const [column, row] = [i % columns, Math.floor(i / columns)];
    return { i, x: (column - (columns - 1) / 2) * SPACING.x, z: (row - (rows - 1) / 2) * SPACING.z };
  });
  return { platforms, project: camera(width, height, columns, rows) };
}

function draw(context, size, before, after, share, colours, chosen) {
  const { platforms, project } = layout(size);
  for (const place of platforms) {
    const tilt = between(before, after, "tilt", place.i, share);
    const position = between(before, after, "position", place.i, share);
    platform(context, project, place, tilt, position, colours, place.i === chosen);
  }
}

/** The platform under a point of the canvas, and the place on it, in m; of `agent`'s platform if it is given. */
function at(size, after, [x, y], agent) {
  const { platforms, project } = layout(size);
  const away = (place) => {
    const middle = project([place.x, 0, place.z]);
    return Math.hypot(middle.x - x, middle.y - y) / middle.scale;
  };
  const found = agent === undefined ? platforms.reduce((a, b) => (away(b) < away(a) ? b : a)) : platforms[agent];
  if (agent === undefined && away(found) > 1.3 * HALF_SIDE) return null;
  const tilt = after.tilt[found.i];
  const seen = ([u, v]) => project([found.x + u, u * Math.tan(tilt[0]) - v * Math.tan(tilt[1]), found.z + v]);
  let place = [0, 0];
  for (let turn = 0; turn < 4; turn++) {
    const here = seen(place);
    const [alongU, alongV] = [seen([place[0] + 0.01, place[1]]), seen([place[0], place[1] + 0.01])];
    const [a, b] = [(alongU.x - here.x) / 0.01, (alongV.x - here.x) / 0.01];
    const [c, d] = [(alongU.y - here.y) / 0.01, (alongV.y - here.y) / 0.01];
    const [dx, dy] = [x - here.x, y - here.y];
    place = [place[0] + (d * dx - b * dy) / (a * d - b * c), place[1] + (a * dy - c * dx) / (a * d - b * c)];
  }
  return { agent: found.i, place };
}

/** A camera that looks at the middle; whatever the grid, all of it is in the picture. */
function camera(width, height, columns, rows) {
  const distance = 15 + 5.5 * rows + 2 * columns;
  const [sin, cos] = [Math.sin(PITCH), Math.cos(PITCH)];
  const flat = ([x, y, z]) => {
    const [dy, dz] = [y - distance * sin, z - distance * cos];
    const depth = -dy * sin - dz * cos;
    return { x: x / depth, y: -(dy * cos - dz * sin) / depth, depth };
  };
  const [halfX, halfZ] = [((columns - 1) / 2) * SPACING.x + 2.7, ((rows - 1) / 2) * SPACING.z + 2.7];
  const ends = [-1, 1].flatMap((a) => [-1, 1].flatMap((b) => [GROUND, 1].map((y) => flat([a * halfX, y, b * halfZ]))));
  const [xs, ys] = [ends.map(({ x }) => x), ends.map(({ y }) => y)];
  const [left, right, top, bottom] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const focal = Math.min(width / (right - left), height / (bottom - top)) * 0.94;
  return (point) => {
    const { x, y, depth } = flat(point);
    return {
      x: width / 2 + focal * (x - (left + right) / 2),
      y: height / 2 + focal * (y - (top + bottom) / 2),
      scale: focal / depth,
    };
  };
}

function platform(context, project, { x, z }, tilt, position, colours, isChosen) {
  const slope = [Math.tan(tilt[0]), -Math.tan(tilt[1])];
  const surface = (u, v, lift = 0) => project([x + u, u * slope[0] + v * slope[1] + lift, z + v]);

  const shadow = project([x, GROUND, z]);
  context.fillStyle = colours.shade;
  context.beginPath();
  context.ellipse(shadow.x, shadow.y, 2.9 * shadow.scale, 1.55 * shadow.scale, 0, 0, 2 * Math.PI);
  context.fill();

  const top = CORNERS.map(([u, v]) => surface(u, v));
  const bottom = CORNERS.map(([u, v]) => surface(u, v, -THICKNESS));
  for (const [a, b] of [[0, 1], [3, 0], [1, 2], [2, 3]]) {
    fill(context, [top[a], top[b], bottom[b], bottom[a]], a === 2 ? colours.side : colours.edge);
  }
  fill(context, top, colours.top);
  context.strokeStyle = isChosen ? colours.accent : colours.rule;
  context.lineWidth = isChosen ? 2.5 : 1;
  context.stroke();

  const [u, v] = position;
  const inside = (n) => Math.max(-HALF_SIDE, Math.min(HALF_SIDE, n));
  const ring = Array.from({ length: 24 }, (_, k) => {
    const angle = (k / 24) * 2 * Math.PI;
    return surface(inside(u + 0.42 * Math.cos(angle)), inside(v + 0.42 * Math.sin(angle)));
  });
  fill(context, ring, colours.shade);

  const centre = surface(u, v, RADIUS);
  const radius = RADIUS * centre.scale;
  const light = context.createRadialGradient(
    centre.x - 0.35 * radius, centre.y - 0.45 * radius, 0.1 * radius, centre.x, centre.y, radius,
  );
  light.addColorStop(0, colours.glint);
  light.addColorStop(1, colours.ball);
  context.fillStyle = light;
  disc(context, centre.x, centre.y, radius);
  context.fill();
}

function fill(context, points, colour) {
  context.beginPath();
  points.forEach(({ x, y }, i) => (i === 0 ? context.moveTo(x, y) : context.lineTo(x, y)));
  context.closePath();
  context.fillStyle = colour;
  context.fill();
}
