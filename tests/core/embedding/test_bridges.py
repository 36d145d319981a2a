"""The edges that join a body's components are stored with its latent space."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.acap.codec import AcapCodec
from lcollision_core.embedding import Embedding, EmbeddingConfig, train_embedding
from lcollision_core.errors import ModelFileError
from tests.core.tasks.test_contacts import two_tubes

QUICK = EmbeddingConfig(
    n_domains=2, n_domain_codes=3, level1_epochs=2, level2_epochs=0, held_out_stride=0
)


@pytest.fixture(scope="module")
def trained() -> Embedding:
    return train_embedding(two_tubes(), QUICK)


def test_a_stored_latent_space_decodes_by_the_bridges_that_it_was_trained_with(
    trained: Embedding,
) -> None:
    arrays, metadata = trained.to_arrays()
    assert arrays["bridges"].shape[1] == 2
    again, latent = Embedding.from_arrays(arrays, metadata), trained.training_latent[:3]
    np.testing.assert_array_equal(again.decode(latent), trained.decode(latent))
    # Older models have none, and decode as before.
    older = {name: values for name, values in arrays.items() if name != "bridges"}
    before = Embedding.from_arrays(older, metadata)
    assert before.to_arrays()[0].keys() == older.keys()
    codec = AcapCodec(trained.topology, trained.rest_vertices, trained.alignment_weights)
    decoded = before.decode(latent)
    np.testing.assert_array_equal(decoded, codec.decode(trained.decoder.features(latent)))
    assert not np.array_equal(decoded, trained.decode(latent))


@pytest.mark.parametrize("pair", [(0, 100_000), (-1, 3), (5, 5)])
def test_bridges_that_join_nothing_are_refused(trained: Embedding, pair: tuple[int, int]) -> None:
    arrays, metadata = trained.to_arrays()
    arrays["bridges"] = np.array([pair], dtype=np.int32)
    with pytest.raises(ModelFileError, match="bridges must join pairs of its 420 vertices"):
        Embedding.from_arrays(arrays, metadata)
