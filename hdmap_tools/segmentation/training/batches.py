"""Which training images make up a step, and getting them ready ahead of time.

Everything follows from the seed and the number of the step, so a run that goes on from
a checkpoint sees the very batches that it would have seen.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.segmentation.training.augmentation import Augment
from hdmap_tools.segmentation.training.image_pairs import ImagePairs
from hdmap_tools.types import NDArrayByte, NDArrayInt

_ORDER, _AUGMENTATION = 0, 1


def indices_of_step(step: int, batch: int, num_pairs: int, seed: int) -> NDArrayInt:
    """Numbers (batch,) of the images of a step, counted from 0.

    Epochs follow each other without a gap, each in an order of its own, so every image
    is seen equally often and no batch is short.
    """
    positions = np.arange(step * batch, (step + 1) * batch)
    epochs = positions // num_pairs
    indices = np.empty(batch, dtype=np.int64)
    for epoch in np.unique(epochs):
        order = np.random.default_rng((seed, _ORDER, int(epoch))).permutation(num_pairs)
        chosen = epochs == epoch
        indices[chosen] = order[positions[chosen] % num_pairs]
    return indices


class Kept:
    """Images and labels that stay in memory once they were read, as far as there is room; `ImagePairs`.

    Args:
        pairs: To be read.
        max_bytes: Of all that is kept.
    """

    def __init__(self, pairs: ImagePairs, max_bytes: int) -> None:
        self._pairs = pairs
        self._left = max_bytes
        self._kept: dict[int, tuple[NDArrayByte, NDArrayByte]] = {}

    @property
    def name(self) -> str:
        """Of the pairs."""
        return self._pairs.name

    @property
    def label_set(self) -> LabelSet:
        """Of the pairs."""
        return self._pairs.label_set

    def __len__(self) -> int:
        return len(self._pairs)

    def describe(self, index: int) -> str:
        """Names the files, for messages."""
        return self._pairs.describe(index)

    def read(self, index: int) -> tuple[NDArrayByte, NDArrayByte]:
        """An image and its labels; not to be written to."""
        pair = self._kept.get(index)
        if pair is None:
            pair = self._pairs.read(index)
            size = pair[0].nbytes + pair[1].nbytes
            if size <= self._left:
                self._left -= size
                for array in pair:
                    array.setflags(write=False)
                self._kept[index] = pair
        return pair


class Batches:
    """The batches of one process from some step on.

    Args:
        pairs: Images and labels.
        augment: Makes a crop of each.
        batch: Images a step, over all processes.
        seed: Of order and augmentation.
        rank: Number of this process.
        world: Number of processes; each takes every world-th image.
        workers: Threads that read and augment; 0: none, all in the caller's. Reading
            and resizing release the interpreter's lock.
    """

    def __init__(
        self,
        pairs: ImagePairs,
        augment: Augment,
        batch: int,
        seed: int,
        *,
        rank: int = 0,
        world: int = 1,
        workers: int = 1,
    ) -> None:
        self._pairs = pairs
        self._augment = augment
        self._batch = batch
        self._seed = seed
        self._rank = rank
        self._world = world
        self._workers = workers

    def from_step(self, first: int) -> Iterator[tuple[Tensor, Tensor]]:
        """Images (n, 3, crop, crop) float32 and ids (n, crop, crop) int64, without end."""
        if self._workers == 0:
            step = first
            while True:
                yield _stacked([self._sample(*one) for one in self._samples(step)])
                step += 1
        # A worker's own operations on one thread: the cores are the network's.
        pool = ThreadPoolExecutor(self._workers, initializer=torch.set_num_threads, initargs=(1,))
        waiting: deque[list[Future[Any]]] = deque()
        try:
            step = first
            while True:
                while len(waiting) < 2:
                    waiting.append([pool.submit(self._sample, *one) for one in self._samples(step)])
                    step += 1
                yield _stacked([future.result() for future in waiting.popleft()])
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _samples(self, step: int) -> list[tuple[int, int]]:
        indices = indices_of_step(step, self._batch, len(self._pairs), self._seed)
        first = step * self._batch
        return [
            (int(indices[slot]), first + slot)
            for slot in range(self._rank, self._batch, self._world)
        ]

    def _sample(self, index: int, position: int) -> tuple[Tensor, Tensor]:
        rgb, ids = self._pairs.read(index)
        self._pairs.label_set.check(ids, f"The mask of {self._pairs.describe(index)}")
        rng = np.random.default_rng((self._seed, _AUGMENTATION, position))
        image, target = self._augment(rgb, ids, rng)
        return image, target


def _stacked(samples: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    images = torch.stack([image for image, _ in samples])
    # Channels last: a third faster on a CPU, and what a GPU's tensor cores want.
    return (
        images.contiguous(memory_format=torch.channels_last),
        torch.stack([ids for _, ids in samples]),
    )
