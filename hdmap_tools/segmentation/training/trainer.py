"""Training: from pairs of images and labels to a run's folder with weights and figures.

A run's folder holds ``run.json`` (what it was started with), ``checkpoint.pt`` and the
one before, ``best.pt`` (best weights so far with their confusion matrix), ``log.csv``,
``confusion.json`` and, where TensorBoard is installed, ``tensorboard/``.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from hdmap_tools.errors import CheckpointError, ConfigError, LabelError
from hdmap_tools.formats.atomic import atomic_output
from hdmap_tools.labels.label_set import IGNORE_ID
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.training.augmentation import Augment
from hdmap_tools.segmentation.training.batches import Batches, Kept
from hdmap_tools.segmentation.training.checkpoint import (
    BEST,
    read_checkpoint,
    read_state,
    write_checkpoint,
    write_state,
)
from hdmap_tools.segmentation.training.class_weights import class_weights
from hdmap_tools.segmentation.training.image_pairs import ImagePairs
from hdmap_tools.segmentation.training.label_offsets import fit_offsets, sampled_scores
from hdmap_tools.segmentation.training.models import build_model, shift_scores
from hdmap_tools.segmentation.training.overlap_loss import overlap_loss
from hdmap_tools.segmentation.training.presets import AdamW, Sgd
from hdmap_tools.segmentation.training.processes import Processes, joined_processes, unwrapped
from hdmap_tools.segmentation.training.run_settings import RunSettings, read_settings, require_same
from hdmap_tools.segmentation.training.training_log import TrainingLog
from hdmap_tools.segmentation.training.validation import confusion_on, label_ious, mean_iou

_log = logging.getLogger(__name__)

_KEPT_BYTES: Final = 5 * 2**30
"""Of training images kept in memory as they were read, which takes a tenth of a small step."""

_MAX_SKIPPED: Final = 5
"""Steps in a row that may be left out; if more are not finite, the weights are lost."""

CONFUSION_NAME: Final = "confusion.json"

Told = Callable[[dict[str, float]], None]
"""Called after each validation with the row of the log."""

Stepped = Callable[[float], None]
"""Called after each step with the share (0..1) of the run that is done."""


def train(
    run: Path,
    train_pairs: ImagePairs,
    val_pairs: ImagePairs | None,
    settings: RunSettings,
    *,
    resume: bool = False,
    workers: int = 1,
    checkpoint_every_s: float = 60.0,
    told: Told | None = None,
    stepped: Stepped | None = None,
) -> None:
    """Train a network, or go on where a run was stopped.

    On CPUs the result follows from settings and data alone (unless a time limit ends it),
    also when the run was killed and went on.

    Args:
        run: Folder of the run; made, or with `resume` there already.
        train_pairs: Images to learn from, in the settings' label set.
        val_pairs: Images to be judged on, in the same; None: never judged, and the
            exported model has no confusion matrix.
        settings: How to train.
        resume: Go on from the run's last checkpoint.
        workers: Threads that read and augment images.
        checkpoint_every_s: At most so much work is lost when the run is killed.
        told: Hears of each validation.
        stepped: Hears of each step.

    Raises:
        CheckpointError: If there is nothing to go on from, the run has other settings, or
            a checkpoint cannot be written.
        ConfigError: If the loss is no longer finite.
        LabelError: If the pairs are in another label set, or a mask holds a wrong id.
        ImageError: If an image or mask is damaged.
    """
    for pairs in (train_pairs, val_pairs):
        if pairs is not None and pairs.label_set != settings.label_set:
            raise LabelError(
                f"{pairs.name} is in label set {pairs.label_set.name!r}, but the network shall learn "
                f"{settings.label_set.name!r}; relabel the pairs."
            )
    torch.set_num_threads(settings.threads)
    with joined_processes() as processes:
        if resume:
            require_same(run, read_settings(run), settings)
        elif processes.is_first:
            run.mkdir(parents=True, exist_ok=True)
            settings.write(run)
        training = _Training(run, train_pairs, val_pairs, settings, processes)
        if resume:
            training.restore(read_checkpoint(run))
        processes.wait()
        training.go(workers, checkpoint_every_s, told or _unheard, stepped or _unheard)


def _unheard(_: Any) -> None:
    pass


class _Training:
    def __init__(
        self,
        run: Path,
        train_pairs: ImagePairs,
        val_pairs: ImagePairs | None,
        settings: RunSettings,
        processes: Processes,
    ) -> None:
        self.run, self.settings, self.processes = run, settings, processes
        self.train_pairs, self.val_pairs = train_pairs, val_pairs
        preset, device = settings.preset, processes.device
        torch.manual_seed(settings.seed)
        model = build_model(preset, len(settings.label_set))
        # Channels last before the optimizer takes the weights: its state follows their layout.
        model = model.to(device, memory_format=torch.channels_last)
        self.optimizer = _optimizer(preset.optimizer, model)
        self.model = processes.joined(model)
        self.averaged: AveragedModel | None = None
        if preset.averaged_steps is not None:
            mean = _fading_mean(preset.averaged_steps)
            self.averaged = AveragedModel(model, avg_fn=mean, use_buffers=True)
        weights = class_weights(train_pairs, preset.class_weight_power, settings.seed)
        self.loss = nn.CrossEntropyLoss(
            torch.tensor(weights, dtype=torch.float32, device=device), ignore_index=IGNORE_ID
        )
        is_gpu = device.type == "cuda"
        half = torch.bfloat16 if not is_gpu or torch.cuda.is_bf16_supported() else torch.float16
        self.autocast = (device.type, half, is_gpu or settings.bfloat16)
        # float16 alone underflows; bfloat16 has the range of float32.
        self.scaler = torch.amp.GradScaler(device.type, enabled=half == torch.float16)
        self.step, self.elapsed_s, self.best_miou = 0, 0.0, -math.inf
        self.num_skipped = 0

    def restore(self, state: dict[str, Any]) -> None:
        try:
            unwrapped(self.model).load_state_dict(state["model"])
            if self.averaged is not None:
                self.averaged.load_state_dict(state["averaged"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.scaler.load_state_dict(state["scaler"])
            self.step, self.elapsed_s = state["step"], state["elapsed_s"]
            self.best_miou = state["best_miou"]
        except (KeyError, RuntimeError, ValueError) as error:
            raise CheckpointError(
                f"The checkpoint of run {self.run} is of another network or version: {error}"
            ) from error
        _log.info("Going on from step %d of run %s.", self.step, self.run)

    def go(self, workers: int, checkpoint_every_s: float, told: Told, stepped: Stepped) -> None:
        preset, processes = self.settings.preset, self.processes
        batches = Batches(
            Kept(self.train_pairs, _KEPT_BYTES),
            Augment(preset.augmentation),
            preset.batch,
            self.settings.seed,
            rank=processes.rank,
            world=processes.world,
            workers=workers,
        ).from_step(self.step)
        log = None
        if processes.is_first:
            names = [f"iou {name}" for name in self.settings.label_set.names]
            columns = ["step", "epoch", "minutes", "learning_rate", "loss", "miou", *names]
            log = TrainingLog(self.run, columns, self.step)
        began, before_s, saved = time.monotonic(), self.elapsed_s, time.monotonic()
        losses: list[float] = []
        progress = processes.of_first(self.settings.progress(self.step, self.elapsed_s))
        try:
            while progress < 1:
                rate = preset.optimizer.rate(progress)
                losses.append(self._step(*next(batches), rate))
                self.step += 1
                self.elapsed_s = before_s + time.monotonic() - began
                progress = processes.of_first(self.settings.progress(self.step, self.elapsed_s))
                stepped(progress)
                is_due = self.step % self.settings.validate_every == 0 or progress >= 1
                if is_due:
                    row = self._row(losses, rate)
                    losses = []
                    if log is not None:
                        log.add(row)
                        told(row)
                is_old = time.monotonic() - saved >= checkpoint_every_s
                if processes.is_first and (is_due or is_old):
                    self.elapsed_s = before_s + time.monotonic() - began
                    write_checkpoint(self.run, self._state())
                    saved = time.monotonic()
        finally:
            batches.close()  # type: ignore[attr-defined]
            if log is not None:
                log.close()
        self._judge_best()

    def _step(self, images: Tensor, ids: Tensor, rate: float) -> float:
        # Dropout must not depend on whether the run was interrupted.
        torch.manual_seed(hash((self.settings.seed, self.step, self.processes.rank)))
        device = self.processes.device
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.model.train()
        buffers = [buffer.clone() for buffer in self.model.buffers()]
        kind, half, enabled = self.autocast
        preset = self.settings.preset
        inputs: tuple[Any, ...] = (images.to(device, non_blocking=True),)
        if preset.judges_every_second_pixel:
            offset = self.step // 2 % 2, self.step % 2
            inputs, ids = (*inputs, offset), ids[:, offset[0] :: 2, offset[1] :: 2]
        with torch.autocast(kind, half, enabled=enabled):
            logits = self.model(*inputs)
        # Channels first again: the loss takes a quarter less time so.
        logits = logits.float().contiguous()
        if bool((ids != IGNORE_ID).any()):
            ids = ids.to(device, non_blocking=True)
            loss = self.loss(logits, ids)
            if preset.overlap_weight > 0:
                loss = loss + preset.overlap_weight * overlap_loss(logits, ids)
        else:  # the mean over no pixel is NaN, and would be for ever
            loss = logits.sum() * 0
        self.optimizer.zero_grad(set_to_none=True)
        self.scaler.scale(loss).backward()
        self.scaler.unscale_(self.optimizer)
        longest = preset.max_gradient_norm
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), longest or math.inf)
        value = float(loss.detach())
        if not self.scaler.is_enabled() and not (math.isfinite(value) and math.isfinite(norm)):
            self._skip(buffers, value, rate)
            return math.nan
        self.num_skipped = 0
        self.scaler.step(self.optimizer)
        self.scaler.update()
        if self.averaged is not None:
            self.averaged.update_parameters(unwrapped(self.model))
        return value

    @property
    def judged(self) -> nn.Module:
        """The network that is validated, kept and exported."""
        return unwrapped(self.model) if self.averaged is None else self.averaged.module

    def _skip(self, buffers: list[Tensor], loss: float, rate: float) -> None:
        """Leave a step out whose loss or gradient is not finite, as mixed precision on GPUs does.

        Kernels of bfloat16 on CPUs gave NaN once in a few hundred steps, for batches that
        were fine when asked again.
        """
        self.num_skipped += 1
        if self.num_skipped > _MAX_SKIPPED:
            raise ConfigError(
                f"The loss is {loss} at step {self.step} and was not finite in the {_MAX_SKIPPED} steps "
                f"before: the learning rate {rate:g} is too high for this data; start anew with a lower "
                "--learning-rate."
            )
        _log.warning("Step %d left out: its loss or gradient is not finite.", self.step)
        # The moving means of the normalization have seen it already.
        for now, before in zip(self.model.buffers(), buffers, strict=True):
            now.copy_(before)
        self.optimizer.zero_grad(set_to_none=True)

    def _row(self, losses: list[float], rate: float) -> dict[str, float]:
        """What the log says of now; also keeps the weights where they are the best so far."""
        settings = self.settings
        row: dict[str, float] = {
            "step": self.step,
            "epoch": self.step * settings.preset.batch / settings.num_train,
            "minutes": self.elapsed_s / 60,
            "learning_rate": rate,
            "loss": float(np.nanmean(losses)) if losses else math.nan,
        }
        if self.val_pairs is None:
            self._keep(None)
            return row
        matrix = self._validated(settings.preset.validate_images)
        row["miou"] = mean_iou(matrix)
        row |= {f"iou {name}": iou for name, iou in label_ious(matrix).items()}
        if row["miou"] > self.best_miou:
            self.best_miou = row["miou"]
            self._keep(matrix)
        return row

    def _validated(self, at_most: int) -> ConfusionMatrix:
        assert self.val_pairs is not None
        preset, processes, labels = self.settings.preset, self.processes, self.settings.label_set
        num = len(self.val_pairs)
        chosen = np.unique(np.linspace(0, num - 1, min(num, at_most)).round().astype(int))
        mine = confusion_on(
            self.judged,
            self.val_pairs,
            [int(index) for index in chosen[processes.rank :: processes.world]],
            preset.augmentation,
            processes.device,
            long_side_px=preset.validate_long_side_px,
            bfloat16=self.settings.bfloat16,
        )
        source = f"{len(chosen)} of {num} validation images of {self.val_pairs.name}"
        return ConfusionMatrix(labels, labels, processes.total(mine.counts), source)

    def _keep(self, matrix: ConfusionMatrix | None, offsets: list[float] | None = None) -> None:
        if self.processes.is_first:
            state = {
                "offsets": offsets,
                "model": self.judged.state_dict(),
                "step": self.step,
                "confusion": None if matrix is None else matrix.to_json(),
            }
            write_state(self.run / BEST, state)

    def _judge_best(self) -> None:
        """Measure the best weights on all validation images: what is exported with them."""
        self.processes.wait()
        best = read_state(self.run / BEST)
        self.judged.load_state_dict(best["model"])
        if self.val_pairs is None:
            return
        self.step = best["step"]
        offsets = best.get("offsets")
        matrix = self._validated(len(self.val_pairs))
        if offsets is None and self.settings.preset.fits_offsets:
            offsets, matrix = self._with_offsets(matrix)
        if self.processes.is_first:
            self._keep(matrix, offsets)
            with atomic_output(self.run / CONFUSION_NAME, overwrite=True) as temporary:
                temporary.write_text(matrix.to_json(), encoding="utf-8")
            said = {k: round(v, 4) for k, v in label_ious(matrix).items() if not math.isnan(v)}
            _log.info("Best at step %d: IoU %s.", self.step, json.dumps(said))

    def _with_offsets(self, before: ConfusionMatrix) -> tuple[list[float], ConfusionMatrix]:
        """Move the scores of the labels to the best mean IoU on validation images.

        Args:
            before: What the network does as it is, on all of them.

        Returns:
            By how much, and what it does then; all 0 and as before where that is no better.
        """
        assert self.val_pairs is not None
        preset, num = self.settings.preset, len(self.val_pairs)
        chosen = np.unique(np.linspace(0, num - 1, min(num, preset.validate_images)).astype(int))
        model = self.judged
        # Each process finds the same.
        scores, truth = sampled_scores(
            model, self.val_pairs, chosen.tolist(), preset.augmentation, self.processes.device
        )
        offsets = [round(float(offset), 3) for offset in fit_offsets(scores, truth)]
        weights = {k: v.clone() for k, v in model.state_dict().items()}
        shift_scores(model, offsets)
        after = self._validated(num)
        # They were found on few pixels; all of them have the last word.
        if mean_iou(after) <= mean_iou(before):
            model.load_state_dict(weights)
            return [0.0] * len(offsets), before
        said = dict(zip(self.settings.label_set.names, offsets, strict=True))
        _log.info("Scores of the labels moved by %s.", json.dumps(said))
        return offsets, after

    def _state(self) -> dict[str, Any]:
        return {
            "model": unwrapped(self.model).state_dict(),
            "averaged": None if self.averaged is None else self.averaged.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "scaler": self.scaler.state_dict(),
            "step": self.step,
            "elapsed_s": self.elapsed_s,
            "best_miou": self.best_miou,
        }


def _fading_mean(num_steps: int) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """A mean of weights over about the last steps; over the last ninth of a run that is younger."""

    def mean(averaged: Tensor, now: Tensor, number: Tensor) -> Tensor:
        if not averaged.is_floating_point():  # the count of batches seen
            return now
        return averaged.lerp(now, max(1 / num_steps, 9 / (9 + int(number))))

    return mean


def _optimizer(recipe: Sgd | AdamW, model: nn.Module) -> torch.optim.Optimizer:
    if isinstance(recipe, Sgd):
        return torch.optim.SGD(
            model.parameters(),
            recipe.learning_rate,
            momentum=recipe.momentum,
            weight_decay=recipe.weight_decay,
        )
    # Decay pulls weights towards 0; scales and shifts of a normalization do not belong there.
    kernels = [p for p in model.parameters() if p.ndim > 1]
    others = [p for p in model.parameters() if p.ndim <= 1]
    groups = [
        {"params": kernels, "weight_decay": recipe.weight_decay},
        {"params": others, "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, recipe.learning_rate)
