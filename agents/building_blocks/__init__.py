"""Parts of which agents are built: policies, critics, advantages, batches, surrogates, running scales."""
