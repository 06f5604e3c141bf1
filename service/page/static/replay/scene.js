// Episodes on one ground in three dimensions, with a camera that somebody turns and that follows them.

import { colour } from "../base/curves.js";
import { moment, pointAt, smoothed, waypointAt } from "./motion.js";
import { robot } from "./robot.js";
import { dispose, ground, track, waypoint } from "./surroundings.js";
import { theatre } from "./theatre.js";

/** A scene in an element. Episodes share one ground; the k-th has bars in the colour `bar-a` or `bar-b`. */
export function scene(place, episodes, letters) {
  const paths = episodes.map(smoothed);
  let parts = [], time_s = 0;
  const stage = theatre(place, episodes.length > 1, build);

  function build() {
    parts.forEach((part) => part.groups.forEach((group) => (dispose(group), stage.world.remove(group))));
    parts = episodes.map((episode, k) => {
      const shade = colour(letters[k] === "B" ? "bar-b" : "cap");
      const body = robot(episode, colour(letters[k] === "B" ? "bar-b" : "bar-a"), episodes.length > 1 && letters[k]), way = track(episode, shade), mark = waypoint(episode, shade), below = ground(episode);
      const groups = [body.group, way.group, mark.group, below];
      stage.world.add(...groups);
      return { episode, body, way, mark, groups };
    });
    show(time_s);
  }

  function show(now_s) {
    time_s = now_s;
    const sum = [0, 0, 0];
    for (const [k, { episode, body, way, mark }] of parts.entries()) {
      const at = moment(episode, time_s);
      body.show(at);
      way.upTo(at.row);
      mark.to(waypointAt(episode, at.row));
      pointAt(paths[k], at).forEach((value, axis) => (sum[axis] += value));
    }
    stage.centreOn(sum.map((value) => value / parts.length));
  }

  const look = () => stage.look(episodes[0].com_m, waypointAt(episodes[0], 0));
  stage.restyle();
  look();
  return { show, look, follow: stage.follow, render: stage.render, nodes: (k) => parts[k].body.nodes(), close: stage.close };
}
