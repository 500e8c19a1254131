"""One step of a learned simulator: past positions in, next positions out."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gns_model.learned import features
from gns_model.learned.config import ModelConfig
from gns_model.learned.contact import project
from gns_model.learned.crowding import spread
from gns_model.learned.graph import radius_graph
from gns_model.learned.network import EncodeProcessDecode
from gns_model.learned.world import MATERIAL_FEATURES, World


class LearnedModel(nn.Module):
    """A graph network simulator (Choi & Kumar, section "GNS"), in SI units.

    Buffers, all of shape (D,): velocity_mean, velocity_std [m/s], acceleration_mean,
    acceleration_std [m/s²]; the acceleration's are those of a - g if gravity is subtracted.
    """

    velocity_mean: Tensor
    velocity_std: Tensor
    acceleration_mean: Tensor
    acceleration_std: Tensor

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        embedded = config.type_embedding if config.types else 0
        self.type_embedding = (
            nn.Embedding(config.types, config.type_embedding) if config.types else None
        )
        self.network = EncodeProcessDecode(
            config.vertex_inputs + embedded,
            config.edge_inputs,
            config.dim,
            latent=config.latent,
            hidden=config.hidden_width,
            hidden_layers=config.hidden_layers,
            blocks=config.blocks,
            activation=config.activation,
            edge_update=config.edge_update,
        )
        for name in ("velocity", "acceleration"):
            self.register_buffer(f"{name}_mean", torch.zeros(config.dim))
            self.register_buffer(f"{name}_std", torch.ones(config.dim))

    @torch.no_grad()
    def set_normalisation(
        self,
        *,
        velocity_mean: Tensor,
        velocity_std: Tensor,
        acceleration_mean: Tensor,
        acceleration_std: Tensor,
    ) -> None:
        """Set the buffers, each of shape (D,), in m/s and m/s². Standard deviations exceed 0."""
        self.velocity_mean.copy_(velocity_mean)
        self.velocity_std.copy_(velocity_std)
        self.acceleration_mean.copy_(acceleration_mean)
        self.acceleration_std.copy_(acceleration_std)
        if not (self.velocity_std > 0).all() or not (self.acceleration_std > 0).all():
            raise ValueError("standard deviations must be positive")

    def acceleration(self, history: Tensor, world: World) -> Tensor:
        """Normalised acceleration of every point, shape (N, D).

        Args:
            history: the last positions [m], oldest first, shape (N, H + 1, D).
            world: surroundings of the N points.
        """
        config = self.config
        if history.shape[1:] != (config.history + 1, config.dim):
            raise ValueError(
                f"history must have shape (N, {config.history + 1}, {config.dim}), "
                f"got {tuple(history.shape)}"
            )
        positions = history[:, -1]
        velocities = (history[:, 1:] - history[:, :-1]) / config.dt
        normalised = (velocities - self.velocity_mean) / self.velocity_std
        senders, receivers = radius_graph(
            positions, config.radius, world.batch, self_edges=config.self_edges
        )
        # As fast as a strain of this rate moves neighbours past each other.
        least = config.strain_unit * config.radius / self.velocity_std.square().mean().sqrt()
        edge, distance = features.edge_features(
            positions,
            normalised[:, -1] if config.relative_velocity else None,
            senders,
            receivers,
            config.radius,
            least if config.strain_unit else None,
        )
        weight = features.envelope(distance) if config.envelope else None
        vertex = self._vertex_features(
            positions, velocities[:, -1], normalised, world, senders, receivers
        )
        return self.network(vertex, edge, senders, receivers, weight)

    def _vertex_features(
        self,
        positions: Tensor,
        velocity: Tensor,
        normalised: Tensor,
        world: World,
        senders: Tensor,
        receivers: Tensor,
    ) -> Tensor:
        config = self.config
        parts = [
            normalised.flatten(1),
            features.wall_features(
                positions,
                world.point_lower,
                world.point_upper,
                config.radius if config.walls == "clip" else config.wall_range,
                clip=config.wall_clip if config.walls == "clip" else None,
            ),
        ]
        if config.baffles == "distance":
            usual = self.velocity_std.square().mean().sqrt()
            parts.append(
                features.baffle_features(
                    positions,
                    velocity / usual,
                    world.point_boxes,
                    config.baffle_range,
                    world.point_frames,
                )
            )
        if config.depth_range:
            parts.append(
                features.depth_features(
                    positions, world.moving, world.batch, config.depth_range, config.spacing
                )
            )
        if config.strain_unit:
            parts.append(
                features.strain_features(
                    positions, velocity, senders, receivers, config.radius, config.strain_unit
                )
            )
        if config.material_features:
            columns = [MATERIAL_FEATURES.index(name) for name in config.material_features]
            parts.append(world.point_material[:, columns])
        if self.type_embedding is not None:
            parts.append(self.type_embedding(world.particle_type))
        return torch.cat(parts, dim=1)

    def predict(self, history: Tensor, world: World) -> Tensor:
        """Positions one stride later [m], shape (N, D): semi-implicit Euler, then contact, of
        grains with walls and baffles and, where there is a limit, with each other.

        v' = v + a dt, p' = p + v' dt, of kinematic points too.
        """
        config = self.config
        predicted = self.acceleration(history, world)
        acceleration = predicted * self.acceleration_std + self.acceleration_mean
        if config.subtract_gravity:
            acceleration = acceleration + world.point_gravity
        before, now = history[:, -2], history[:, -1]
        after = now + ((now - before) + acceleration * config.dt**2)
        if config.project:
            after = project(now, after, world)
        if config.crowding_limit:
            spaced = spread(after, world, config.spacing, config.crowding_limit)
            after = project(after, spaced, world) if config.project else spaced
        return after

    def step(self, history: Tensor, world: World) -> Tensor:
        """`predict`, but kinematic points stay where they are."""
        after = self.predict(history, world)
        if self.config.baffles != "distance":
            after = torch.where(world.moving[:, None], after, history[:, -1])
        return after
