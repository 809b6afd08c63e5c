"""Common parts of all algorithms: actor and critics, networks, policies, advantages, batches, surrogates."""
