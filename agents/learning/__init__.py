"""Common parts of all algorithms: actor and critics, policies, advantages, batches, surrogates."""
